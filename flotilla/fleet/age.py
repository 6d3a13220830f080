"""Encryption by a passphrase in the format age (age-encryption.org/v1), which the program `age` decrypts, too.

scrypt derives the key from the passphrase, ChaCha20-Poly1305 encrypts and authenticates. The specification is at
https://age-encryption.org/v1.
"""

from __future__ import annotations

import base64
import binascii
import hmac
import os
import re

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.kdf.hkdf import HKDF
from cryptography.hazmat.primitives.kdf.scrypt import Scrypt

LOG2_COST = 18
"""Of scrypt when this module encrypts, as of `age`: 256 MiB of memory for each guess of a passphrase."""
_MOST_LOG2_COST = 20
"""1 GiB: a file must not take all memory of the computer that decrypts it."""
_VERSION = b"age-encryption.org/v1"
_HEADER = re.compile(
    _VERSION + rb"\n-> scrypt (?P<salt>[A-Za-z0-9+/]{22}) (?P<cost>[1-9][0-9]?)\n(?P<key>[A-Za-z0-9+/]{43})\n---"
)
_MAC = re.compile(rb" (?P<mac>[A-Za-z0-9+/]{43})\n")
_CHUNK_BYTES, _TAG_BYTES, _FILE_KEY_BYTES, _NONCE_BYTES = 1 << 16, 16, 16, 16
_NO_NONCE = bytes(12)


class DecryptionError(Exception):
    """Wrong passphrase, changed file, or another format; the message has the reason."""


def encrypt(content: bytes, passphrase: str) -> bytes:
    """An age file for one passphrase."""
    file_key, salt, nonce = os.urandom(_FILE_KEY_BYTES), os.urandom(16), os.urandom(_NONCE_BYTES)
    wrapped = ChaCha20Poly1305(_wrap_key(passphrase, salt, LOG2_COST)).encrypt(_NO_NONCE, file_key, None)
    header = b"%s\n-> scrypt %s %d\n%s\n---" % (_VERSION, _base64(salt), LOG2_COST, _base64(wrapped))
    cipher = ChaCha20Poly1305(_derived(file_key, nonce, b"payload"))
    chunks = [content[at : at + _CHUNK_BYTES] for at in range(0, len(content), _CHUNK_BYTES)] or [b""]
    sealed = [cipher.encrypt(_nonce(n, n == len(chunks) - 1), chunk, None) for n, chunk in enumerate(chunks)]
    return b"".join([header, b" ", _base64(_mac(file_key, header)), b"\n", nonce, *sealed])


def decrypt(data: bytes, passphrase: str) -> bytes:
    """The content of an age file for one passphrase; DecryptionError unless all of it is as it was encrypted."""
    if not (header := _HEADER.match(data)) or not (mac := _MAC.match(data, header.end())):
        raise DecryptionError("is no age file that is encrypted with a passphrase")
    if (cost := int(header["cost"])) > _MOST_LOG2_COST:
        raise DecryptionError(f"scrypt's cost is 2^{cost}, which takes more memory than 2^{_MOST_LOG2_COST}")
    try:
        wrap_key = _wrap_key(passphrase, _bytes(header["salt"]), cost)
        file_key = ChaCha20Poly1305(wrap_key).decrypt(_NO_NONCE, _bytes(header["key"]), None)
    except InvalidTag:
        raise DecryptionError("the passphrase is wrong, or the file was changed") from None
    if not hmac.compare_digest(_mac(file_key, header[0]), _bytes(mac["mac"])):
        raise DecryptionError("the file was changed")
    return _payload(data[mac.end() :], file_key)


def _payload(data: bytes, file_key: bytes) -> bytes:
    nonce, sealed = data[:_NONCE_BYTES], data[_NONCE_BYTES:]
    cipher = ChaCha20Poly1305(_derived(file_key, nonce, b"payload"))
    step = _CHUNK_BYTES + _TAG_BYTES
    chunks = [sealed[at : at + step] for at in range(0, len(sealed), step)] or [b""]
    try:
        return b"".join(cipher.decrypt(_nonce(n, n == len(chunks) - 1), each, None) for n, each in enumerate(chunks))
    except InvalidTag:
        raise DecryptionError("the file was changed, or its end is missing") from None


def _nonce(number: int, last: bool) -> bytes:
    return number.to_bytes(11, "big") + bytes([last])


def _wrap_key(passphrase: str, salt: bytes, log2_cost: int) -> bytes:
    scrypt = Scrypt(salt=_VERSION + b"/scrypt" + salt, length=32, n=1 << log2_cost, r=8, p=1)
    return scrypt.derive(passphrase.encode())


def _derived(file_key: bytes, salt: bytes, purpose: bytes) -> bytes:
    return HKDF(hashes.SHA256(), length=32, salt=salt, info=purpose).derive(file_key)


def _mac(file_key: bytes, header: bytes) -> bytes:
    return hmac.digest(_derived(file_key, b"", b"header"), header, "sha256")


def _base64(data: bytes) -> bytes:
    return base64.b64encode(data).rstrip(b"=")


def _bytes(text: bytes) -> bytes:
    """Of base64 without padding, in the one form that is allowed."""
    try:
        data = base64.b64decode(text + b"=" * (-len(text) % 4), validate=True)
    except binascii.Error:
        data = b""
    if _base64(data) != text:
        raise DecryptionError("the file was changed")
    return data
