"""Messages that prove who sent them, in Python, both sides: what runtime/core/authentication.h says."""

from __future__ import annotations

import contextlib
import enum
import hmac
import secrets
import socket
import struct
from collections.abc import Iterable

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

_NUMBERS = struct.Struct("<QQQ")
"""Session, counter, and the answer or the challenge."""
_TAG = 16
_CHALLENGE = _NUMBERS.size + _TAG
_AT_ONCE = 100
TRAILER = _NUMBERS.size + _TAG
"""Bytes that a message has behind its payload."""


class Verdict(enum.Enum):
    """On a message."""

    GOOD = enum.auto()
    FORGED = enum.auto()
    """The tag is wrong."""
    REPLAYED = enum.auto()
    """It came before, or a newer one did."""
    UNANSWERED = enum.auto()
    """Its sender has yet to answer a challenge, so it may be a recorded one."""


class _Key:
    """Of messages from one computer to one port of another."""

    def __init__(self, key: str, port: int) -> None:
        """`key`: 64 hexadecimal digits, as `MessageKeys.between` has them."""
        self._key = bytes.fromhex(key)
        self._port = struct.pack("<H", port)
        self._messages = ChaCha20Poly1305(self._digest(b"M"))

    def tag(self, payload: bytes, numbers: bytes) -> bytes:
        """Of a message."""
        return self._messages.encrypt(self._nonce(numbers), b"", payload + numbers)

    def tags(self, payload: bytes, numbers: bytes, tag: bytes) -> bool:
        """Whether the tag is that of the message."""
        try:
            self._messages.decrypt(self._nonce(numbers), tag, payload + numbers)
        except InvalidTag:
            return False
        return True

    def challenge_tag(self, numbers: bytes) -> bytes:
        return self._digest(b"C", numbers)[:_TAG]

    @staticmethod
    def _nonce(numbers: bytes) -> bytes:
        return numbers[:12]  # the session, and the lower half of the counter

    def _digest(self, kind: bytes, signed: bytes = b"") -> bytes:
        return hmac.digest(self._key, kind + self._port + signed, "sha256")


class Signer:
    """Of messages to one port of one robot, from when it is made: a session."""

    def __init__(self, key: str, port: int) -> None:
        """`key`: 64 hexadecimal digits, as `MessageKeys.between` has them."""
        self._key = _Key(key, port)
        self._session = secrets.randbits(64)
        self._counter = self._answer = self._challenged = 0

    def sign(self, payload: bytes) -> bytes:
        """The payload with its trailer. Each call is a message of its own, and is to be sent at most once."""
        self._counter += 1
        numbers = _NUMBERS.pack(self._session, self._counter, self._answer)
        return payload + numbers + self._key.tag(payload, numbers)

    def challenged(self, datagram: bytes) -> bool:
        """Take what came back. False: it is no challenge of the robot to this session, or an older one."""
        if len(datagram) != _CHALLENGE:
            return False
        numbers, tag = datagram[: _NUMBERS.size], datagram[_NUMBERS.size :]
        session, counter, challenge = _NUMBERS.unpack(numbers)
        if session != self._session or not self._challenged < counter <= self._counter:
            return False
        if not hmac.compare_digest(self._key.challenge_tag(numbers), tag):
            return False
        self._challenged, self._answer = counter, challenge
        return True

    def hear(self, one: socket.socket) -> None:
        """Take the challenges that have come back to a socket of its own, without waiting for any."""
        receive_challenges(one, [self])


def receive_challenges(one: socket.socket, signers: Iterable[Signer]) -> None:
    """Hand each challenge that has come back to a socket to the one of its signers that it is for, without waiting."""
    with contextlib.suppress(BlockingIOError):
        for _ in range(_AT_ONCE):
            with contextlib.suppress(ConnectionRefusedError):  # nobody listened to an earlier message
                datagram = one.recv(_CHALLENGE + 1, socket.MSG_DONTWAIT)
                any(signer.challenged(datagram) for signer in signers)


class Verifier:
    """Of messages from one computer to one port of this one, from when it is made: it knows no session yet."""

    def __init__(self, key: str, port: int) -> None:
        """As of `Signer`."""
        self._key = _Key(key, port)
        self._secret = secrets.token_bytes(32)
        """Of this verifier alone: its challenges cannot be guessed."""
        self._taken = self._counter = self._answer = 0
        """Sessions taken so far, and what the last message of the newest had."""
        self._session: int | None = None

    def judge(self, message: bytes) -> tuple[Verdict, bytes]:
        """What to think of it, with the payload of a good one, the challenge to send back to an UNANSWERED one, or
        nothing. ValueError: it is shorter than a trailer."""
        if len(message) < TRAILER:
            raise ValueError(f"{len(message)} bytes: a trailer has {TRAILER}")
        payload, trailer = message[:-TRAILER], message[-TRAILER:]
        numbers, tag = trailer[: _NUMBERS.size], trailer[_NUMBERS.size :]
        if not self._key.tags(payload, numbers, tag):
            return Verdict.FORGED, b""
        session, counter, answer = _NUMBERS.unpack(numbers)
        known = session == self._session
        if known and counter <= self._counter:
            return Verdict.REPLAYED, b""
        if not known or answer != self._answer:
            wanted = self._wanted(session)
            if answer != wanted:
                asked = _NUMBERS.pack(session, counter, wanted)
                return Verdict.UNANSWERED, asked + self._key.challenge_tag(asked)
            self._session, self._answer = session, answer
            self._taken += 1
        self._counter = counter
        return Verdict.GOOD, payload

    def _wanted(self, session: int) -> int:
        """The answer that is wanted of a session that is not taken; it holds until the next is taken."""
        digest = hmac.digest(self._secret, struct.pack("<QQ", session, self._taken), "sha256")
        return int.from_bytes(digest[:8], "little")
