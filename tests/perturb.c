/*
 * Perturbs how the host schedules QEMU's two threads, to be loaded before QEMU: now and then a thread stops for a while
 * where it leaves the guest's code (siglongjmp) or where it was woken (ppoll), as if the processor had gone to somebody
 * else. What repeats under this repeats on any host.
 *
 * At its end a process adds how often it was stopped to the file that PERTURB_LOG names.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <poll.h>
#include <setjmp.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#define INSTEAD __attribute__((visibility("default")))

struct stops {
    unsigned one_in; /* of so many calls, one stops */
    uint64_t at_most_ns;
};
static const struct stops LEAVING = {10, 200 * 1000}, WOKEN = {2, 300 * 1000};

static unsigned long stopped;

static uint64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

static void stop(const struct stops *stops)
{
    static _Thread_local uint64_t random; /* xorshift64; every run is another */
    uint64_t begin = now_ns();
    if (random == 0)
        random = (begin ^ (uintptr_t)&random) | 1u;
    random ^= random << 13;
    random ^= random >> 7;
    random ^= random << 17;
    if ((random >> 8) % stops->one_in != 0)
        return;
    __atomic_fetch_add(&stopped, 1, __ATOMIC_RELAXED);
    /* Busy, because a sleep this short would be as long as the host's timer slack. */
    while (now_ns() - begin < (random >> 32) % stops->at_most_ns)
        continue;
}

static void *original(const char *name)
{
    void *found = dlsym(RTLD_NEXT, name);
    if (found == NULL)
        abort();
    return found;
}

typedef void jump(sigjmp_buf, int);

#define LEAVE(jump_away)                                                                                               \
    INSTEAD void jump_away(sigjmp_buf environment, int value)                                                          \
    {                                                                                                                  \
        static jump *there;                                                                                            \
        if (there == NULL)                                                                                             \
            there = (jump *)original(#jump_away);                                                                      \
        stop(&LEAVING);                                                                                                \
        there(environment, value);                                                                                     \
        abort();                                                                                                       \
    }
LEAVE(siglongjmp)
LEAVE(__longjmp_chk) /* what Debian's hardened build of QEMU calls */

INSTEAD int ppoll(struct pollfd *files, nfds_t count, const struct timespec *timeout, const sigset_t *signals)
{
    static int (*wait)(struct pollfd *, nfds_t, const struct timespec *, const sigset_t *);
    if (wait == NULL)
        *(void **)&wait = original("ppoll");
    int ready = wait(files, count, timeout, signals);
    stop(&WOKEN);
    return ready;
}

__attribute__((destructor)) static void report(void)
{
    const char *path = getenv("PERTURB_LOG");
    FILE *log = path != NULL ? fopen(path, "a") : NULL;
    if (log == NULL)
        return;
    fprintf(log, "%lu\n", stopped);
    fclose(log);
}
