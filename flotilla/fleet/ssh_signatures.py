"""Signatures by SSH keys (`ssh-keygen -Y`, PROTOCOL.sshsig of OpenSSH): in a file, an agent or a hardware token."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from flotilla.common.errors import UserError

_SIGNER = "signer"


def is_in_agent(public: str) -> bool:
    """Whether an agent (`SSH_AUTH_SOCK`) has the private half of a public key, given without comment."""
    done = subprocess.run(["ssh-add", "-L"], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    return done.returncode == 0 and public in {" ".join(line.split()[:2]) for line in done.stdout.splitlines()}


def sign(content: bytes, key: Path, namespace: str) -> bytes:
    """By a private key's file, or a public one's if an agent has the private half. `namespace`: the only use of the
    signature."""
    argv = ["ssh-keygen", "-Y", "sign", "-q", "-n", namespace, "-f", str(key)]
    done = subprocess.run(argv, input=content, capture_output=True, check=False)
    if done.returncode:
        raise UserError(f"{' '.join(argv)} failed: {done.stderr.decode(errors='replace').strip()}")
    return done.stdout


def sign_by_agent(content: bytes, public: str, namespace: str) -> bytes:
    """By a key of which the agent has the private half."""
    with tempfile.NamedTemporaryFile("w", prefix="signer-", suffix=".pub") as file:
        file.write(f"{public}\n")
        file.flush()
        return sign(content, Path(file.name), namespace)


def is_signed(content: bytes, signature: Path, public: Sequence[str], namespace: str) -> bool:
    """Whether one of these public keys has made the signature of this content."""
    with tempfile.NamedTemporaryFile("w", prefix="signers-") as allowed:
        allowed.write("".join(f'{_SIGNER} namespaces="{namespace}" {key}\n' for key in public))
        allowed.flush()
        argv = ["ssh-keygen", "-Y", "verify", "-f", allowed.name, "-I", _SIGNER, "-n", namespace, "-s", str(signature)]
        return subprocess.run(argv, input=content, capture_output=True, check=False).returncode == 0
