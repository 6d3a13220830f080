# A kernel for the boot loader alone: says on COM1 by which command line it was started, and stands still.
# With RELEASE defined it says before which release it is, and whether all of it and of its initramfs was loaded. Its
# words, and those of the initramfs, add up to a certain value: flotilla/lab/power_cuts/releases.py sees to it, and fills in what
# is marked so.
# What the fields mean: Documentation/arch/x86/boot.rst in the kernel's source.
        .code32
        .org 0x1f1
        .byte 1                         # setup_sects: one sector follows the first, then the program
        .word 0
        .long 32                        # syssize, in 16 bytes; with RELEASE: filled in
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
.ifdef RELEASE
        jmp begin
        .org 0x410
words:  .long 0                         # of the program: filled in
name:   .space 32                       # of the release: filled in
.endif
begin:  call here
here:   pop %ebp
        lea intro - here(%ebp), %ebx
        call say
.ifdef RELEASE
        lea release - here(%ebp), %ebx
        call say
        lea name - here(%ebp), %ebx
        call say
        lea space - here(%ebp), %ebx
        call say
        lea program - here(%ebp), %edi
        mov words - here(%ebp), %ecx
        call judge
        mov 0x218(%esi), %edi           # ramdisk_image
        mov 0x21c(%esi), %ecx           # ramdisk_size, in bytes
        shr $2, %ecx
        call judge
.endif
        mov 0x228(%esi), %ebx           # cmd_line_ptr
        call say
        lea end - here(%ebp), %ebx
        call say
halt:   cli
        hlt
        jmp halt

.ifdef RELEASE
judge:  mov $0x464c4f54, %eax           # ecx words at edi; from a value on, since zeros must not add up
        lea whole - here(%ebp), %ebx
        jecxz broken                    # nothing was loaded
add:    add (%edi), %eax
        add $4, %edi
        dec %ecx
        jnz add
        test %eax, %eax
        jz say
broken: lea torn - here(%ebp), %ebx
.endif

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

intro:  .asciz "\r\nstub kernel: "
.ifdef RELEASE
release: .asciz "release "
space:  .asciz " "
whole:  .asciz "whole "
torn:   .asciz "TORN "
.endif
end:    .asciz "\r\nstub kernel ends\r\n"
        .org 0x600
