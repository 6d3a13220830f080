"""The sender's side of messages that prove who sent them, in Python: what runtime/core/authentication.h says."""

from __future__ import annotations

import hmac
import secrets
import struct

from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

_NUMBERS = struct.Struct("<QQQ")
"""Session, counter, and the answer or the challenge."""
_TAG = 16
_CHALLENGE = _NUMBERS.size + _TAG


class Signer:
    """Of messages to one port of one robot, from when it is made: a session."""

    def __init__(self, key: str, port: int) -> None:
        """`key`: 64 hexadecimal digits, as `MessageKeys.between` has them."""
        self._key = bytes.fromhex(key)
        self._port = struct.pack("<H", port)
        self._messages = ChaCha20Poly1305(self._digest(b"M"))
        self._session = secrets.randbits(64)
        self._counter = self._answer = self._challenged = 0

    def sign(self, payload: bytes) -> bytes:
        """The payload with its trailer. Each call is a message of its own, and is to be sent at most once."""
        self._counter += 1
        numbers = _NUMBERS.pack(self._session, self._counter, self._answer)
        nonce = numbers[:12]  # the session, and the lower half of the counter
        return payload + numbers + self._messages.encrypt(nonce, b"", payload + numbers)

    def challenged(self, datagram: bytes) -> bool:
        """Take what came back. False: it is no challenge of the robot to this session, or an older one."""
        if len(datagram) != _CHALLENGE:
            return False
        numbers, tag = datagram[: _NUMBERS.size], datagram[_NUMBERS.size :]
        session, counter, challenge = _NUMBERS.unpack(numbers)
        if session != self._session or not self._challenged < counter <= self._counter:
            return False
        if not hmac.compare_digest(self._digest(b"C", numbers)[:_TAG], tag):
            return False
        self._challenged, self._answer = counter, challenge
        return True

    def _digest(self, kind: bytes, signed: bytes = b"") -> bytes:
        return hmac.digest(self._key, kind + self._port + signed, "sha256")
