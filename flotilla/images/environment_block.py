"""GRUB's environment block: lines NAME=VALUE in a fixed number of bytes.

Source: GRUB 2.06 manual, "The GRUB environment block".
"""

from __future__ import annotations

from collections.abc import Mapping

SIGNATURE = "# GRUB Environment Block\n"


def lines(values: Mapping[str, str]) -> str:
    """The lines of these values. GRUB quotes what a backslash and a line's end would be; nothing here needs either."""
    for name, value in values.items():
        if set(value) & set("\\\n"):
            raise ValueError(f"{name}: {value!r} has a backslash or a line's end")
    return "".join(f"{name}={value}\n" for name, value in values.items())


def of(text: str, size: int) -> bytes:
    """The block of `size` bytes that holds these lines."""
    content = (SIGNATURE + text).encode()
    if len(content) > size:
        raise ValueError(f"{len(content)} bytes do not fit into an environment block of {size}")
    return content.ljust(size, b"#")


def make(values: Mapping[str, str], size: int) -> bytes:
    return of(lines(values), size)


def values(block: bytes) -> dict[str, str]:
    """What a block says; nothing where it is none."""
    if not block.startswith(SIGNATURE.encode()):
        return {}
    found = block.decode("ascii", "replace").splitlines()[1:]
    return dict(line.split("=", 1) for line in found if "=" in line and not line.startswith("#"))
