"""Keys by which computers of a fleet authenticate their messages, one for each pair and direction, and their time.

All come from the fleet's secret, which no robot has: the file `fleet_secret` in `paths.KEYS`, 64 hexadecimal digits,
made when first needed. A robot's card has the keys of its own messages alone, so who takes one robot can speak for no
other. Revoking a robot's host key gives it, and the others towards it, new keys. What a message proves is in
runtime/core/authentication.h.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import keys
from flotilla.fleet.model import Host

CREDENTIAL = "message-keys"
"""The file with a robot's keys, among the credentials of its control tasks' services."""
_DIGITS = 64


def secret_file() -> Path:
    return paths.KEYS / "fleet_secret"


@dataclass(frozen=True)
class MessageKeys:
    """A fleet's, as they are now."""

    secret: bytes
    revocations: Mapping[str, int]
    """Of robots' host keys, by name; 0 of whom is not named."""

    def between(self, sender: Host, receiver: Host) -> str:
        """The key of messages from one computer to another, 64 hexadecimal digits."""
        return self.derived(f"messages from {self.identity(sender)} to {self.identity(receiver)}").hex()

    def lines(self, host: Host, others: Iterable[Host]) -> str:
        """Of a computer's file: address of another one, key of messages to it, key of messages from it."""
        return "".join(f"{other.address} {self.between(host, other)} {self.between(other, host)}\n" for other in others)

    def time(self, one: Host, other: Host) -> str:
        """The key of NTP messages between two computers, either way: a line of chrony.keys(5), number, type and key."""
        both = sorted([one, other], key=lambda host: host.name)
        names = " ".join(host.name for host in both)
        number = 1 + int.from_bytes(hashlib.sha256(names.encode()).digest()[:4]) % (2**32 - 1)
        key = self.derived(f"time between {' and '.join(map(self.identity, both))}")
        return f"{number} AES128 HEX:{key[:16].hex().upper()}"

    def identity(self, host: Host) -> str:
        """A computer's name, and how often its keys were revoked."""
        return f"{host.name} {self.revocations.get(host.name, 0)}"

    def derived(self, words: str) -> bytes:
        """A key for what the words say: 32 bytes."""
        return hmac.new(self.secret, words.encode(), hashlib.sha256).digest()


def read() -> MessageKeys:
    """The fleet's; the secret is made if there is none."""
    return MessageKeys(_secret(), keys.revocations())


def write_secret(secret: bytes) -> None:
    """Make the file, unless there is one; whole or not at all."""
    keys.write_once(secret_file(), secret.hex() + "\n")


def _secret() -> bytes:
    file = secret_file()
    if not file.exists():
        write_secret(secrets.token_bytes(_DIGITS // 2))
    text = file.read_text().strip()
    try:
        secret = bytes.fromhex(text)
    except ValueError:
        secret = b""
    if len(secret) != _DIGITS // 2:
        raise UserError(
            f"{paths.shown(file)}: is not {_DIGITS} hexadecimal digits; restore it by `make restore-keys`, or remove "
            "it and provision all robots"
        )
    return secret
