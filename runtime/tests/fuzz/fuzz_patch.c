/* libFuzzer's entry for deltas: any bytes, against a base of 4 KiB. Nobody trusts the result, but no byte may be read
 * or written outside of its buffer. Seen to find that an instruction's size was not compared with the window's. */
int flotilla_patch(int argc, char **argv);
#define main flotilla_patch
#include "programs/flotilla_patch.c"
#undef main

#include <sys/mman.h>

int LLVMFuzzerTestOneInput(const uint8_t *given, size_t count);

int LLVMFuzzerTestOneInput(const uint8_t *given, size_t count)
{
    static int base = -1;
    if (base < 0) {
        uint8_t content[4096];
        for (size_t i = 0; i < sizeof content; i++)
            content[i] = (uint8_t)(i * 7 + (i >> 8));
        int nowhere = open("/dev/null", O_WRONLY);
        base = memfd_create("base", 0);
        if (base < 0 || write(base, content, sizeof content) != (ssize_t)sizeof content ||
            dup2(nowhere, STDOUT_FILENO) < 0)
            abort();
        stderr = fopen("/dev/null", "we"); /* of the program alone: sanitizers write to the descriptor */
    }
    FILE *in = count ? fmemopen((void *)(uintptr_t)given, count, "r") : NULL;
    if (!in)
        return 0;
    patch(in, base);
    fclose(in);
    return 0;
}
