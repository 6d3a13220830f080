"""Debian's kernel as robots boot it: packed with LZ4, and its modules without signatures.

Debian packs its 32-bit kernels with xz, which takes an emulated Pentium III 19 virtual seconds of 125 million
instructions to unpack; LZ4 takes a third of one. So the kernel is unpacked when the image is made, and lies behind a
stub of a few instructions in a file of the same format, 8 MB instead of 6. What runs is Debian's to the byte, at the
address it is linked for: what is lost is a random address (CONFIG_RANDOMIZE_BASE).

Format: Linux, Documentation/arch/x86/boot.rst, "The Real-Mode Kernel Header" and "32-bit Boot Protocol".
"""

from __future__ import annotations

import lzma
import struct
from io import BytesIO
from pathlib import Path

import lz4
import lz4.block
from debian.debfile import DebFile
from elftools.elf.elffile import ELFFile

from flotilla.common.errors import UserError

_SETUP_SECTS, _SYSSIZE, _MAGIC = 0x1F1, 0x1F4, 0x202
_RELOCATABLE, _PAYLOAD, _INIT_SIZE = 0x234, 0x248, 0x260
_SECTOR = 512
_SIGNED, _SIGNATURE_BYTES = b"~Module signature appended~\n", 12
PACKER = lz4.library_version_string()
"""What decides the bytes besides this file."""
_XZ = b"\xfd7zXZ\0"
_STUB_BYTES = 128
_LOADED_AT = 0x100000
"""Where boot loaders put the part of a kernel that is not relocatable."""


def of_package(package: Path) -> bytes:
    """The kernel in a Debian package, as robots boot it."""
    with package.open("rb") as content:
        archive = DebFile(fileobj=content).data.tgz()
        kernel = archive.extractfile(next(member for member in archive if member.name.startswith("./boot/vmlinuz-")))
        assert kernel
        return repacked(kernel.read())


def repacked(kernel: bytes) -> bytes:
    """The `kernel` (a bzImage) packed with LZ4 instead of xz; all but 32-bit ones with xz stay what they are."""
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
    packed = lz4.block.compress(bytes(image), mode="high_compression", compression=12, store_size=False)
    if (room := begin - _LOADED_AT - _STUB_BYTES) < len(packed):
        raise UserError(f"the kernel takes {len(packed)} bytes packed; below its place in memory there are {room}")
    protected = _stub(begin, len(packed), elf["e_entry"]) + packed
    protected += bytes(-len(protected) % 16)
    setup = bytearray(kernel[:setup_bytes])
    struct.pack_into("<I", setup, _SYSSIZE, len(protected) // 16)
    struct.pack_into("<II", setup, _PAYLOAD, 0, 0)
    struct.pack_into("<I", setup, _INIT_SIZE, end - _LOADED_AT)
    setup[_RELOCATABLE] = 0
    return bytes(setup + protected)


def without_signature(module: bytes) -> bytes:
    """A kernel module without the signature that Debian appended to it.

    To check them took an emulated Pentium III 5 of the 18 virtual seconds to a task's first period. Nothing is less
    sure without: what a root is made of was compared with the lock's hashes, and no kernel here insists on signatures.
    Format: Linux, include/linux/module_signature.h.
    """
    if not module.endswith(_SIGNED):
        return module
    (length,) = struct.unpack_from(">I", module, len(module) - len(_SIGNED) - 4)
    return module[: -len(_SIGNED) - _SIGNATURE_BYTES - length]


def _stub(begin: int, length: int, entry: int) -> bytes:
    """Unpacks the LZ4 block of `length` bytes behind it to where the kernel is linked for, and starts that.

    ESI points to the boot parameters when it begins and when it ends. No stack is needed, and there is none. The kernel
    clears what follows it (its BSS) itself. Format: LZ4 block format description, "Compressed block format".
    """
    packed = _LOADED_AT + _STUB_BYTES
    longer = b"".join(  # a length of 15 goes on in bytes, the first that is not 255 being its last
        [
            b"\x80\xf9\x0f",  # cmp cl, 15
            b"\x75\x0a",  # jne behind this
            b"\x0f\xb6\x06",  # more: movzx eax, byte [esi]
            b"\x46",  # inc esi
            b"\x01\xc1",  # add ecx, eax
            b"\x3c\xff",  # cmp al, 255
            b"\x74\xf6",  # je more
        ]
    )
    code = b"".join(
        [
            b"\xfa\xfc",  # cli; cld
            b"\x89\xf5",  # mov ebp, esi
            b"\xbe" + struct.pack("<I", packed),  # mov esi, packed
            b"\xbf" + struct.pack("<I", begin),  # mov edi, begin
            # sequence: literals, whose number begins with the token's upper four bits
            b"\xac",  # lodsb
            b"\x88\xc2",  # mov dl, al
            b"\x0f\xb6\xc8",  # movzx ecx, al
            b"\xc1\xe9\x04",  # shr ecx, 4
            longer,
            b"\xf3\xa4",  # rep movsb
            b"\x81\xfe" + struct.pack("<I", packed + length),  # cmp esi, end
            b"\x73\x2a",  # jae done: the last sequence has literals only
            # distance of a match; its length above four begins with the token's lower four bits
            b"\x0f\xb7\x1e",  # movzx ebx, word [esi]
            b"\x83\xc6\x02",  # add esi, 2
            b"\x0f\xb6\xca",  # movzx ecx, dl
            b"\x83\xe1\x0f",  # and ecx, 15
            longer,
            b"\x83\xc1\x04",  # add ecx, 4
            b"\x89\xf0",  # mov eax, esi
            b"\x89\xfe",  # mov esi, edi
            b"\x29\xde",  # sub esi, ebx
            b"\xf3\xa4",  # rep movsb
            b"\x89\xc6",  # mov esi, eax
            b"\xeb\xb4",  # jmp sequence
            b"\x89\xee",  # done: mov esi, ebp
            b"\xb8" + struct.pack("<I", entry),  # mov eax, entry
            b"\xff\xe0",  # jmp eax
        ]
    )
    return code.ljust(_STUB_BYTES, b"\x90")
