"""Debian's kernel without its own unpacking: the same kernel, in a file that the boot loader unpacks faster.

Debian packs its 32-bit kernels with xz, which takes a Pentium III 2.4 thousand million instructions to unpack, as long
as everything until log-in takes. Here the kernel is unpacked when the image is made, and lies behind a stub of a few
instructions in a file of the same format. What runs is Debian's to the byte, at the address it is linked for: what is
lost is a random address (CONFIG_RANDOMIZE_BASE).

Format: Linux, Documentation/arch/x86/boot.rst, "The Real-Mode Kernel Header" and "32-bit Boot Protocol".
"""

from __future__ import annotations

import lzma
import struct
from io import BytesIO

from elftools.elf.elffile import ELFFile

from images.builder.errors import UserError

_SETUP_SECTS, _SYSSIZE, _MAGIC = 0x1F1, 0x1F4, 0x202
_RELOCATABLE, _PAYLOAD, _INIT_SIZE = 0x234, 0x248, 0x260
_SECTOR = 512
_SIGNED, _SIGNATURE_BYTES = b"~Module signature appended~\n", 12
_XZ = b"\xfd7zXZ\0"
_LOADED_AT = 0x100000
"""Where boot loaders put the part of a kernel that is not relocatable."""


def without_unpacking(kernel: bytes) -> bytes:
    """The `kernel` (a bzImage) as one that does not unpack itself; all but 32-bit ones with xz stay what they are."""
    if kernel[_MAGIC : _MAGIC + 4] != b"HdrS":
        raise UserError("the kernel is not a bzImage; the boot loader could not start it")
    setup_bytes = (kernel[_SETUP_SECTS] + 1) * _SECTOR
    offset, length = struct.unpack_from("<II", kernel, _PAYLOAD)
    payload = kernel[setup_bytes + offset : setup_bytes + offset + length]
    if not payload.startswith(_XZ):
        return kernel
    elf = ELFFile(BytesIO(lzma.LZMADecompressor().decompress(payload)))
    if elf.elfclass != 32:
        return kernel
    loaded = [segment for segment in elf.iter_segments() if segment["p_type"] == "PT_LOAD"]
    begin = min(segment["p_paddr"] for segment in loaded)
    end = max(segment["p_paddr"] + segment["p_memsz"] for segment in loaded)
    image = bytearray(max(segment["p_paddr"] + segment["p_filesz"] for segment in loaded) - begin)
    for segment in loaded:
        start = segment["p_paddr"] - begin
        image[start : start + segment["p_filesz"]] = segment.data()
    image += bytes(-len(image) % 16)
    protected = _stub(begin, len(image), elf["e_entry"]) + image
    setup = bytearray(kernel[:setup_bytes])
    struct.pack_into("<I", setup, _SYSSIZE, len(protected) // 16)
    struct.pack_into("<II", setup, _PAYLOAD, 0, 0)
    struct.pack_into("<I", setup, _INIT_SIZE, end - _LOADED_AT)
    setup[_RELOCATABLE] = 0
    return bytes(setup + protected)


def without_signature(module: bytes) -> bytes:
    """A kernel module without the signature that Debian appended to it.

    A Pentium III computes with its big number for a quarter of a second per module, thirty times in a boot. Nothing is
    less sure without: what a root is made of was compared with the lock's hashes, and no kernel here insists on it.
    Format: Linux, include/linux/module_signature.h.
    """
    if not module.endswith(_SIGNED):
        return module
    (length,) = struct.unpack_from(">I", module, len(module) - len(_SIGNED) - 4)
    return module[: -len(_SIGNED) - _SIGNATURE_BYTES - length]


def _stub(begin: int, length: int, entry: int) -> bytes:
    """Moves the kernel to where it is linked for and starts it; ESI, the boot parameters, is kept.

    The highest addresses first: the places overlap. The kernel clears what follows it (its BSS) itself.
    """
    size = 32
    last = 4
    code = b"".join(
        [
            b"\xfa",  # cli
            b"\x89\xf2",  # mov edx, esi
            b"\xbe" + struct.pack("<I", _LOADED_AT + size + length - last),  # mov esi, its last word
            b"\xbf" + struct.pack("<I", begin + length - last),  # mov edi, where that belongs
            b"\xb9" + struct.pack("<I", length // 4),  # mov ecx, words
            b"\xfd\xf3\xa5\xfc",  # std; rep movsd; cld
            b"\x89\xd6",  # mov esi, edx
            b"\xb8" + struct.pack("<I", entry),  # mov eax, entry
            b"\xff\xe0",  # jmp eax
        ]
    )
    return code.ljust(size, b"\x90")
