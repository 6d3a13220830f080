"""Debian packages as files: what one says of itself, and the same package without compression."""

from __future__ import annotations

import lzma
import os
from pathlib import Path

from debian.arfile import ArFile
from debian.debfile import DebFile

_HEADER = 60
"""Bytes before each member of the archive."""
_CHUNK = 1 << 20


def control(package: Path) -> str:
    """Its description of itself. ValueError where the package is damaged."""
    try:
        with package.open("rb") as content:
            text = DebFile(fileobj=content).control.get_content("control", encoding="utf-8")
    except Exception as error:  # python-debian names none
        raise ValueError(f"no Debian package: {error}") from error
    assert isinstance(text, str)
    return text


def without_compression(package: Path, new: Path) -> None:
    """Write `new`, the package with its files as they are: dpkg, which comes later, need not unpack them.

    Format: deb(5).
    """
    with package.open("rb") as content, new.open("wb") as out:
        out.write(b"!<arch>\n")
        for member in ArFile(fileobj=content).getmembers():
            name, unpacker = member.name, None
            if name == "data.tar.xz":
                name, unpacker = "data.tar", lzma.LZMADecompressor()
            begin = out.seek(_HEADER, os.SEEK_CUR)
            while chunk := member.read(_CHUNK):
                out.write(unpacker.decompress(chunk) if unpacker else chunk)
            size = out.tell() - begin
            out.write(b"\n" * (size % 2))
            end = out.tell()
            out.seek(begin - _HEADER)
            out.write(f"{name:<16}{0:<12}{0:<6}{0:<6}{'100644':<8}{size:<10}`\n".encode())
            out.seek(end)
