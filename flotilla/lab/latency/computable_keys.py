"""A fleet's keys that everybody can compute, for runs that repeat: they need the same ones everywhere."""

from __future__ import annotations

import base64
import hashlib
import struct
from collections.abc import Iterable

from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from flotilla.common import paths
from flotilla.fleet import dds_security, message_keys

_SECRET = bytes(32)
_PRIMES = (
    (
        "ee03c2f354b1c11b3da3c48dcad7232083a9c33c8a9a4ef9b1cc5559122bf104"
        "fcfa566a8ffaeafd889ec2df5ecc46d4cb1d0abeb6e287784e8dd17b289b8edc"
        "1b04def7930ae5b8073654dc12faac7e85c2f95117a759561be2e15012efbfac"
        "c0b814ec88142c7db1048d4a55a668b44a8ed1be98f5da7d8295b590670da0fb"
    ),
    (
        "caee77e2b556f37effa579431a6bbb891efc89b190e5082fba193ec59674138d"
        "d29446a22452982da97c9a656d837bc401f6259b20dbd1372eae32c92f37b1d5"
        "1a4dd7b3ce35350a0b81ce0bfc5987df5836b87d3ad8696d030f583dfae3f11a"
        "fdc0431c2e91d88b16f5969f9e75158853f0bc330035be2ae08f7fbc56491f47"
    ),
)
"""Of the authority's RSA key, in hexadecimal digits."""
_EXPONENT = 65537


def write(ssh: Iterable[str] = ()) -> None:
    """Into `paths.KEYS`; `ssh`: the files of SSH keys besides."""
    message_keys.write_secret(_SECRET)
    p, q = (int(digits, 16) for digits in _PRIMES)
    exponent = rsa.rsa_recover_private_exponent(_EXPONENT, p, q)
    numbers = rsa.RSAPrivateNumbers(
        p, q, exponent, rsa.rsa_crt_dmp1(exponent, p), rsa.rsa_crt_dmq1(exponent, q), rsa.rsa_crt_iqmp(p, q),
        rsa.RSAPublicNumbers(_EXPONENT, p * q),
    )  # fmt: skip
    dds_security.write_authority(numbers.private_key())
    for name in ssh:
        private, public = ssh_key(name)
        (paths.KEYS / name).write_text(private)
        (paths.KEYS / f"{name}.pub").write_text(public)


def ssh_key(name: str) -> tuple[str, str]:
    """A key pair in OpenSSH's format."""

    def text(data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + data

    seed = hashlib.sha256(f"flotilla latency {name}".encode()).digest()
    public = Ed25519PrivateKey.from_private_bytes(seed).public_key().public_bytes_raw()
    blob = text(b"ssh-ed25519") + text(public)
    private = bytes(8) + blob + text(seed + public) + text(name.encode())
    private += bytes(range(1, 1 + -len(private) % 8))
    whole = b"openssh-key-v1\0" + text(b"none") * 2 + text(b"") + struct.pack(">I", 1) + text(blob) + text(private)
    lines = base64.encodebytes(whole).decode().replace("\n", "")
    body = "\n".join(lines[start : start + 70] for start in range(0, len(lines), 70))
    return (
        f"-----BEGIN OPENSSH PRIVATE KEY-----\n{body}\n-----END OPENSSH PRIVATE KEY-----\n",
        f"ssh-ed25519 {base64.b64encode(blob).decode()} {name}\n",
    )
