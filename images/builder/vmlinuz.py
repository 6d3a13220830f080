"""Debian's kernel, packed otherwise.

xz, which Debian packs its 32-bit kernels with, takes a Pentium III 2.4 thousand million instructions to unpack: as
many as all that follows until log-in. LZ4 takes a fiftieth. So the kernel is unpacked when the image is made, and
lies behind a stub of a few instructions in a file of the same format, 8 MB instead of 6. (Not packed it would be 15,
which a boot loader takes two seconds more to read.) What runs is Debian's to the byte, at the address it is linked
for: what is lost is a random address (CONFIG_RANDOMIZE_BASE).

Format: Linux, Documentation/arch/x86/boot.rst, "The Real-Mode Kernel Header" and "32-bit Boot Protocol".
"""

from __future__ import annotations

import lzma
import struct
from io import BytesIO

import lz4.block
from elftools.elf.elffile import ELFFile

from images.builder.errors import UserError

_SETUP_SECTS, _SYSSIZE, _MAGIC = 0x1F1, 0x1F4, 0x202
_RELOCATABLE, _PAYLOAD, _INIT_SIZE = 0x234, 0x248, 0x260
_SECTOR = 512
_SIGNED, _SIGNATURE_BYTES = b"~Module signature appended~\n", 12
_XZ = b"\xfd7zXZ\0"
_STUB_BYTES = 128
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

    A Pentium III computes with its big number for a quarter of a second per module, thirty times in a boot. Nothing is
    less sure without: what a root is made of was compared with the lock's hashes, and no kernel here insists on it.
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
    code = b"".join(
        [
            b"\xfa\xfc",  # cli; cld
            b"\x89\xf5",  # mov ebp, esi
            b"\xbe" + struct.pack("<I", packed),  # mov esi, packed
            b"\xbf" + struct.pack("<I", begin),  # mov edi, begin
            # sequence: literals, of which there are the upper four bits of the token, and what follows while it is 255
            b"\xac",  # lodsb
            b"\x88\xc2",  # mov dl, al
            b"\x0f\xb6\xc8",  # movzx ecx, al
            b"\xc1\xe9\x04",  # shr ecx, 4
            b"\x80\xf9\x0f",  # cmp cl, 15
            b"\x75\x0a",  # jne literals
            b"\x0f\xb6\x06",  # more: movzx eax, byte [esi]
            b"\x46",  # inc esi
            b"\x01\xc1",  # add ecx, eax
            b"\x3c\xff",  # cmp al, 255
            b"\x74\xf6",  # je more
            b"\xf3\xa4",  # literals: rep movsb
            b"\x81\xfe" + struct.pack("<I", packed + length),  # cmp esi, end
            b"\x73\x2a",  # jae done: the last sequence has literals only
            # match: distance, and length above four likewise in the lower four bits of the token
            b"\x0f\xb7\x1e",  # movzx ebx, word [esi]
            b"\x83\xc6\x02",  # add esi, 2
            b"\x0f\xb6\xca",  # movzx ecx, dl
            b"\x83\xe1\x0f",  # and ecx, 15
            b"\x80\xf9\x0f",  # cmp cl, 15
            b"\x75\x0a",  # jne match
            b"\x0f\xb6\x06",  # more: movzx eax, byte [esi]
            b"\x46",  # inc esi
            b"\x01\xc1",  # add ecx, eax
            b"\x3c\xff",  # cmp al, 255
            b"\x74\xf6",  # je more
            b"\x83\xc1\x04",  # match: add ecx, 4
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
