"""Kernels packed otherwise. That one boots, and as fast as it is said to, the boots show."""

from __future__ import annotations

import lzma
import struct

import lz4.block
import pytest

from flotilla.common.errors import UserError
from flotilla.images import debian_kernel

SETUP_SECTS = 3
AT = 0x1000000
STUB = 128
CODE = bytes(range(1, 241))


def elf(kind: int = 1) -> bytes:
    """A program of two segments, the second of which has a page more in memory than in the file."""
    header = b"\x7fELF" + bytes([kind, 1, 1]).ljust(12, b"\0")
    header += struct.pack("<HHIIIIIHHHHHH", 2, 3, 1, AT + 4, 52, 0, 0, 52, 32, 2, 0, 0, 0)
    header = header.ljust(64, b"\0") if kind == 2 else header
    first = struct.pack("<8I", 1, 0x200, 0xC0000000 + AT, AT, 200, 200, 5, 16)
    second = struct.pack("<8I", 1, 0x300, 0xC0000000 + AT + 0x400, AT + 0x400, 40, 0x1000, 6, 16)
    return (header + first + second).ljust(0x200, b"\0") + CODE[:200].ljust(0x100, b"\0") + CODE[200:]


def bzimage(payload: bytes) -> bytes:
    setup = bytearray((SETUP_SECTS + 1) * 512)
    setup[0x1F1] = SETUP_SECTS
    setup[0x202:0x206] = b"HdrS"
    setup[0x234] = 1
    struct.pack_into("<II", setup, 0x248, 16, len(payload))
    return bytes(setup) + bytes(16) + payload + b"the program that unpacks"


def test_the_kernel_is_packed_as_it_lies_in_memory() -> None:
    """Seen to fail with the second segment at its place in the file instead of in memory."""
    kernel = debian_kernel.repacked(bzimage(lzma.compress(elf()) + struct.pack("<I", len(elf()))))
    setup, protected = kernel[: (SETUP_SECTS + 1) * 512], kernel[(SETUP_SECTS + 1) * 512 :]
    stub, packed = protected[:STUB], protected[STUB:]
    (end,) = struct.unpack_from("<I", stub, stub.index(b"\x81\xfe") + 2)  # cmp esi, end
    image = lz4.block.decompress(packed[: end - 0x100000 - STUB], uncompressed_size=0x428)
    assert image[:200] == CODE[:200]
    assert image[0x400:0x428] == CODE[200:]
    assert set(image[200:0x400]) == {0}
    assert not setup[0x234], "a boot loader would put it somewhere else"
    assert struct.unpack_from("<I", setup, 0x1F4) == (len(protected) // 16,)
    assert struct.unpack_from("<I", setup, 0x260) == (AT + 0x1400 - 0x100000,)
    assert stub.rstrip(b"\x90").endswith(struct.pack("<I", AT + 4) + b"\xff\xe0")


@pytest.mark.parametrize("payload", [b"\x02\x21\x4c\x18LZ4", lzma.compress(elf(kind=2))], ids=["LZ4", "64-bit"])
def test_another_kind_of_kernel_stays_what_it_is(payload: bytes) -> None:
    """Our own kernel is packed with LZ4; one of 64 bits expects more of who starts it."""
    kernel = bzimage(payload)
    assert debian_kernel.repacked(kernel) == kernel


def test_what_is_no_kernel_is_refused() -> None:
    with pytest.raises(UserError, match="not a bzImage"):
        debian_kernel.repacked(bytes(4096))


def test_a_module_loses_its_signature_and_nothing_else() -> None:
    module = b"\x7fELF" + bytes(100) + b"its last bytes"
    signature = bytes(range(200))
    described = struct.pack(">8xI", len(signature))
    signed = module + signature + described + b"~Module signature appended~\n"
    assert debian_kernel.without_signature(signed) == module
    assert debian_kernel.without_signature(module) == module
