"""The smallest computer that tests the test lab: one sector that greets on COM1 and COM2 and echoes what they get."""

from __future__ import annotations

from flotilla.fleet.model import Board

GREETING = "tiny computer ready"

BOARD = Board.model_validate(
    {
        "name": "tiny",
        "description": "a PC that runs one sector",
        "architecture": "i386",
        "kernel": "debian",
        "kernel_arguments": [],
        "console": {"tty": "ttyS0", "baud": 115200},
        "ports": {"COM1": {"tty": "ttyS0"}, "COM2": {"tty": "ttyS1"}},
        "network_interface": "eth0",
        "disk_modules": ["ata_piix"],
        "qemu": {
            "system": "i386",
            "machine": "pc-i440fx-7.2",
            "cpu": "pentium3",
            "memory_mib": 64,
            "disk": "ide",
            "network": "i82559er",
            "devices": ["isa-serial,index=1,chardev=port1"],
        },
    }
)

_CODE = """
31 c0 8e d8 8e d0   #        xor ax,ax; mov ds,ax; mov ss,ax
bc 00 7c            #        mov sp,0x7c00
fc                  #        cld
ba f8 03 e8 14 00   #        mov dx,0x3f8 (COM1); call greet
b6 02 e8 0f 00      #        mov dh,2 (COM2); call greet
fb f4               # serve: sti; hlt (until the next timer tick, to leave the host's processor to others)
ba f8 03 e8 14 00   #        mov dx,0x3f8; call echo
b6 02 e8 0f 00      #        mov dh,2; call echo
eb f1               #        jmp serve
be 53 7c            # greet: mov si,text
ac 84 c0 74 26      # next:  lodsb; test al,al; jz done
e8 13 00 eb f6      #        call put; jmp next
80 c2 05 ec         # echo:  add dl,5; in al,dx (line status)
80 ea 05            #        sub dl,5
a8 01 74 16         #        test al,1 (received); jz done
ec e8 02 00 eb ef   #        in al,dx; call put; jmp echo
88 c4 80 c2 05      # put:   mov ah,al; add dl,5
ec a8 20 74 fb      # wait:  in al,dx; test al,0x20 (ready to send); jz wait
80 ea 05 88 e0 ee   #        sub dl,5; mov al,ah; out dx,al
c3                  # done:  ret
"""
"""Runs at 0x7c00; the text follows at 0x7c53."""


def disk() -> bytes:
    """A disk of one megabyte that the BIOS boots."""
    code = bytes.fromhex("".join(line.partition("#")[0] for line in _CODE.splitlines()))
    sector = (code + GREETING.encode() + b"\r\n\0").ljust(510, b"\0") + b"\x55\xaa"
    return sector.ljust(1024 * 1024, b"\0")
