/* A library in a release whose control tasks overrun. The release loads it into every program; those that sleep until a
 * moment as real-time threads, which control tasks do before each step, are busy for more than a period after every
 * second one: the runtime gives a task up that overruns again and again without a step on time between. */
#define _GNU_SOURCE
#include <errno.h>
#include <sched.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#ifdef SYS_clock_nanosleep_time64 /* times have 64 bits on robots of 32 bits, too */
#define SLEEP SYS_clock_nanosleep_time64
#else
#define SLEEP SYS_clock_nanosleep
#endif
_Static_assert(sizeof(time_t) == 8, "compile it with _TIME_BITS=64");

enum { BUSY_NS = 11 * 1000 * 1000, SECOND_NS = 1000 * 1000 * 1000 };

__attribute__((visibility("default"))) int clock_nanosleep(clockid_t clock, int flags, const struct timespec *until,
                                                           struct timespec *left)
{
    if (syscall(SLEEP, clock, flags, until, left) < 0)
        return errno;
    static _Thread_local unsigned sleeps;
    if (!(flags & TIMER_ABSTIME) || sched_getscheduler(0) != SCHED_FIFO || ++sleeps % 2)
        return 0;
    struct timespec begin, now;
    clock_gettime(CLOCK_MONOTONIC, &begin);
    do
        clock_gettime(CLOCK_MONOTONIC, &now);
    while ((now.tv_sec - begin.tv_sec) * (long long)SECOND_NS + (now.tv_nsec - begin.tv_nsec) < BUSY_NS);
    return 0;
}
