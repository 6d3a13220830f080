# A kernel for the boot loader alone: says on COM1 by which command line it was started, and stands still.
# What the fields mean: Documentation/arch/x86/boot.rst in the kernel's source.
        .code32
        .org 0x1f1
        .byte 1                         # setup_sects: one sector follows the first, then the program
        .word 0
        .long 32                        # syssize, in 16 bytes
        .word 0, 0, 0
        .word 0xaa55
        .byte 0xeb, 0x66                # jump over the header: says where that ends
        .ascii "HdrS"
        .word 0x0206                    # version of the protocol
        .org 0x211
        .byte 1                         # loadflags: the program belongs above 1 MiB
        .org 0x214
        .long 0x100000                  # code32_start
        .org 0x22c
        .long 0x37ffffff                # initrd_addr_max
        .long 0x1000                    # kernel_alignment
        .byte 0                         # relocatable_kernel
        .org 0x238
        .long 2047                      # cmdline_size

        .org 0x400
program:                                # esi: the boot parameters
        call here
here:   pop %ebp
        lea said - here(%ebp), %ebx
        call say
        mov 0x228(%esi), %ebx           # cmd_line_ptr
        call say
        lea end - here(%ebp), %ebx
        call say
halt:   cli
        hlt
        jmp halt

say:    mov (%ebx), %cl
        inc %ebx
        test %cl, %cl
        jz done
        mov $0x3fd, %dx                 # line status: wait until it takes a byte
wait:   in (%dx), %al
        test $0x20, %al
        jz wait
        mov $0x3f8, %dx
        mov %cl, %al
        out %al, (%dx)
        jmp say
done:   ret

said:   .asciz "\r\nstub kernel: "
end:    .asciz "\r\nstub kernel ends\r\n"
        .org 0x600
