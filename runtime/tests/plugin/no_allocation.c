/* Preloaded: ends the process when the thread that is named in NO_ALLOCATION_IN allocates or frees. */
#define _GNU_SOURCE
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <unistd.h>

extern void *__libc_malloc(size_t bytes);
extern void *__libc_calloc(size_t count, size_t bytes);
extern void *__libc_realloc(void *memory, size_t bytes);
extern void __libc_free(void *memory);

static void judge(void)
{
    static const char said[] = "allocation in a control step\n";
    char name[17] = "";
    const char *watched = getenv("NO_ALLOCATION_IN");
    if (watched && prctl(PR_GET_NAME, name) == 0 && strcmp(name, watched) == 0) {
        ssize_t written = write(STDERR_FILENO, said, sizeof said - 1);
        _exit(written > 0 ? 99 : 98);
    }
}

void *malloc(size_t bytes)
{
    judge();
    return __libc_malloc(bytes);
}

void *calloc(size_t count, size_t bytes)
{
    judge();
    return __libc_calloc(count, bytes);
}

void *realloc(void *memory, size_t bytes)
{
    judge();
    return __libc_realloc(memory, bytes);
}

void free(void *memory)
{
    if (memory)
        judge();
    __libc_free(memory);
}
