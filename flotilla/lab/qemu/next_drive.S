# Code of an MBR that starts the BIOS's drive 0x81, as a boot menu or another system's loader on drive 0x80 does.
        .code16
start:  xor %ax, %ax
        mov %ax, %ds
        mov %ax, %es
        mov %ax, %ss
        mov $0x7c00, %sp
        cld
        mov $0x7c00, %si                # out of the way of the other MBR
        mov $0x600, %di
        mov $256, %cx
        rep movsw
        ljmp $0, $0x600 + moved - start
moved:  mov $0x0201, %ax                # read one sector
        mov $1, %cx                     # the first
        mov $0x0081, %dx
        mov $0x7c00, %bx
        int $0x13
        ljmp $0, $0x7c00                # with the drive in dl, as the BIOS has it
