"""All keys of a fleet in one file: a tar, encrypted by a passphrase in the format age (age.py).

The passphrase comes from the terminal or from a file. The keys in the clear are never on a disk but where they belong.
Earlier backups are vaults of Ansible (PBKDF2 with 10,000 rounds), which a restore still reads.

Everybody who knows the passphrase can write a backup, so a restore does not unpack the tar by its own words: names,
kinds and sizes are checked here, and each file becomes a private one in the directory of keys.
"""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from flotilla.common import ansible, durable, paths
from flotilla.common.errors import UserError
from flotilla.fleet import age, keys, passphrases

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}")
"""Of a key or a list: in no other directory, and no file that begins with a dot."""
_FILE_BYTES = 1 << 20
"""A key has hundreds, a list of keys some ten thousand."""
_MOST_FILES = 10_000
_VAULT = b"$ANSIBLE_VAULT;"
"""How an earlier backup begins."""


def backup(to: Path, password: Path | None) -> int:
    """Write the file, for its owner alone; how many keys and lists are in it. `password`: the passphrase's file."""
    files = {file.name: file.read_bytes() for file in _files(paths.KEYS)}
    if not files:
        raise UserError(f"{paths.shown(paths.KEYS)}: there are no keys; `make image ROBOT=3` makes them")
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w") as archive:
        for name, data in files.items():  # of a link what it leads to: on another computer it leads nowhere
            member = tarfile.TarInfo(name)
            member.size, member.mode = len(data), 0o600
            if wrong := _wrong(member):
                raise UserError(f"{paths.shown(paths.KEYS / name)}: {wrong}; move it away, or give it another name")
            archive.addfile(member, io.BytesIO(data))
    data = age.encrypt(content.getvalue(), passphrases.read(password, new=True))
    try:
        durable.write(to, data, private=True)
    except OSError as error:
        raise UserError(f"OUT={to}: {error.strerror}; give a file in a directory that you may write to") from error
    return len(files)


def restore(source: Path, password: Path | None) -> int:
    """Put keys back where there are none; how many files. UserError, and nothing is changed, where others are."""
    if not source.is_file():
        raise UserError(f"{paths.shown(source)}: no such file; `make backup-keys OUT=FILE` makes one")
    files = _unpacked(source, _decrypted(source, password))
    with keys.alone():  # nobody makes a key meanwhile that the backup has
        if others := [file.name for file in _files(paths.KEYS) if file.read_bytes() != files.get(file.name)]:
            raise UserError(
                f"{paths.shown(paths.KEYS)}: {', '.join(others)}: not those of the backup; move them away first"
            )
        _write(files)
    return len(files)


def _unpacked(source: Path, content: bytes) -> dict[str, bytes]:
    """Files of a backup by name; UserError where it has anything else."""
    files: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(content), mode="r:") as archive:
            for member in archive:
                wrong = "stands twice" if member.name in files else _wrong(member)
                if not wrong and len(files) == _MOST_FILES:
                    wrong = f"is one file more than {_MOST_FILES}"
                if wrong:
                    raise UserError(f"{paths.shown(source)}: no backup of keys: {member.name!r} {wrong}")
                file = archive.extractfile(member)
                files[member.name] = file.read() if file else b""
    except (tarfile.TarError, ValueError, OverflowError) as error:
        raise UserError(f"{paths.shown(source)}: no backup of keys: {error}") from None
    if not files:
        raise UserError(f"{paths.shown(source)}: no backup of keys: there is no file in it")
    return files


def _wrong(member: tarfile.TarInfo) -> str:
    """Why a member of a backup is no key; empty where it may be one."""
    if member.type not in (tarfile.REGTYPE, tarfile.AREGTYPE) or member.issparse():
        return "is no plain file"
    if not _NAME.fullmatch(member.name):
        return "is no name of a key: letters, digits, underscores, dots and hyphens, no dot first"
    if member.size > _FILE_BYTES:
        return f"has {member.size} bytes, a key or a list has at most {_FILE_BYTES}"
    return ""


def _write(files: dict[str, bytes]) -> None:
    """Beside their places, and only when all are on the disk to these: no loss of power makes half a key."""
    with tempfile.TemporaryDirectory(dir=paths.KEYS, prefix=".restored-") as beside:
        new = [Path(beside) / name for name in sorted(files)]
        for file in new:
            with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as stream:
                stream.write(files[file.name])
        durable.rename_files(new, paths.KEYS)


def _files(directory: Path) -> list[Path]:
    """Without what a process that was killed left behind."""
    if not directory.is_dir():
        return []
    return sorted(file for file in directory.iterdir() if file.is_file() and not file.name.startswith("."))


def _decrypted(source: Path, password: Path | None) -> bytes:
    data = source.read_bytes()
    if data.startswith(_VAULT):
        return _of_vault(source, data, password)
    try:
        return age.decrypt(data, passphrases.read(password, new=False))
    except age.DecryptionError as error:
        raise UserError(f"{paths.shown(source)}: no backup of keys: {error}") from None


def _of_vault(source: Path, data: bytes, password: Path | None) -> bytes:
    secret = ["--vault-password-file", str(password.resolve())] if password else ["--ask-vault-pass"]
    argv = [str(Path(sys.executable).with_name("ansible-vault")), "decrypt", *secret, "--output", "-", "-"]
    done = subprocess.run(argv, input=data, env=ansible.environment(), capture_output=True, check=False)
    if done.returncode:
        reason = done.stderr.decode(errors="replace").strip()
        raise UserError(f"{paths.shown(source)}: ansible-vault decrypt: {reason}")
    sys.stderr.write(f"{paths.shown(source)}: has the earlier, weaker encryption; `make backup-keys` makes a new one\n")
    return done.stdout
