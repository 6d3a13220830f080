"""All keys of a fleet in one file, encrypted by a passphrase: Ansible's vault (AES-256, HMAC-SHA256, PBKDF2) of a tar.

`ansible-vault` asks for the passphrase on the terminal, or reads it from a file. The keys in the clear are never on a
disk but where they belong.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

from flotilla.common import durable, paths
from flotilla.common.errors import UserError


def backup(to: Path, password: Path | None) -> int:
    """Write the file, for its owner alone; how many keys and lists are in it. `password`: the passphrase's file."""
    files = _files(paths.KEYS)
    if not files:
        raise UserError(f"{paths.shown(paths.KEYS)}: there are no keys; `make image ROBOT=3` makes them")
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w") as archive:
        for file in files:
            archive.add(file, file.name)
    beside = to.with_name(f".{to.name}.new")
    try:
        _vault("encrypt", password, content.getvalue(), beside)
        beside.chmod(0o600)
        durable.rename(beside, to)
    finally:
        beside.unlink(missing_ok=True)
    return len(files)


def restore(source: Path, password: Path | None) -> int:
    """Put keys back where there are none; how many files. UserError, and nothing is changed, where others are."""
    if not source.is_file():
        raise UserError(f"{paths.shown(source)}: no such file; `make backup-keys OUT=FILE` makes one")
    content = _vault("decrypt", password, source.read_bytes())
    beside = paths.KEYS.with_name(f".{paths.KEYS.name}.new")
    shutil.rmtree(beside, ignore_errors=True)
    try:
        beside.mkdir(mode=0o700, parents=True)
        try:
            with tarfile.open(fileobj=io.BytesIO(content)) as archive:
                archive.extractall(beside, filter="data")
        except tarfile.TarError as error:
            raise UserError(f"{paths.shown(source)}: no backup of keys: {error}") from None
        if others := [file.name for file in _files(paths.KEYS) if not _same(file, beside / file.name)]:
            raise UserError(
                f"{paths.shown(paths.KEYS)}: {', '.join(others)}: not those of the backup; move them away first"
            )
        restored = _files(beside)
        paths.KEYS.mkdir(mode=0o700, parents=True, exist_ok=True)
        for file in restored:
            file.chmod(0o600)
            durable.rename(file, paths.KEYS / file.name)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return len(restored)


def _files(directory: Path) -> list[Path]:
    """Without what a process that was killed left behind."""
    if not directory.is_dir():
        return []
    return sorted(file for file in directory.iterdir() if file.is_file() and not file.name.startswith("."))


def _same(one: Path, other: Path) -> bool:
    return other.is_file() and one.read_bytes() == other.read_bytes()


def _vault(what: str, password: Path | None, content: bytes, out: Path | None = None) -> bytes:
    """What `ansible-vault` makes of its standard input."""
    secret = ["--vault-password-file", str(password.resolve())] if password else ["--ask-vault-pass"]
    if password and not password.is_file():
        raise UserError(f"{password}: no such file; it holds the passphrase of the backup")
    argv = [str(Path(sys.executable).with_name("ansible-vault")), what, *secret, "--output", str(out or "-"), "-"]
    done = subprocess.run(argv, input=content, capture_output=True, check=False)
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip()
        raise UserError(f"ansible-vault {what}: {said}")
    return done.stdout
