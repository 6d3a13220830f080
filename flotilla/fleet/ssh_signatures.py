"""Signatures by SSH keys (`ssh-keygen -Y`, PROTOCOL.sshsig of OpenSSH): in a file, an agent or a hardware token."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from flotilla.common.errors import UserError

_SIGNER = "signer"


def sign(content: bytes, private: Path, namespace: str) -> bytes:
    """By a key's file. `namespace`: what the signature is for; it is none for anything else."""
    argv = ["ssh-keygen", "-Y", "sign", "-q", "-n", namespace, "-f", str(private)]
    done = subprocess.run(argv, input=content, capture_output=True, check=False)
    if done.returncode:
        raise UserError(f"{' '.join(argv)} failed: {done.stderr.decode(errors='replace').strip()}")
    return done.stdout


def is_signed(content: bytes, signature: Path, public: Sequence[str], namespace: str) -> bool:
    """Whether one of these public keys has made the signature of this content."""
    with tempfile.NamedTemporaryFile("w", prefix="signers-") as allowed:
        allowed.write("".join(f'{_SIGNER} namespaces="{namespace}" {key}\n' for key in public))
        allowed.flush()
        argv = ["ssh-keygen", "-Y", "verify", "-f", allowed.name, "-I", _SIGNER, "-n", namespace, "-s", str(signature)]
        return subprocess.run(argv, input=content, capture_output=True, check=False).returncode == 0
