/*
 * The first period of a control task: memory locked, woken at an absolute deadline; the unit makes it SCHED_FIFO.
 *
 *     first_step FILE   writes when that was, in microseconds since the kernel's clock started, and since power on
 *
 * The latter by the time-stamp counter, which in QEMU's virtual time counts nanoseconds.
 */
#define _GNU_SOURCE
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <sys/mman.h>
#include <time.h>

enum { PERIOD_NS = 1000 * 1000 };

int main(int argc, char **argv)
{
    struct timespec next;
    FILE *out;

    if (argc != 2 || sched_getscheduler(0) != SCHED_FIFO || mlockall(MCL_CURRENT | MCL_FUTURE))
        return 1;
    clock_gettime(CLOCK_MONOTONIC, &next);
    next.tv_nsec += PERIOD_NS;
    next.tv_sec += next.tv_nsec / 1000000000;
    next.tv_nsec %= 1000000000;
    if (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, NULL))
        return 1;
    clock_gettime(CLOCK_MONOTONIC, &next);
    uint64_t since_power_on_ns = __builtin_ia32_rdtsc();
    out = fopen(argv[1], "w");
    if (!out)
        return 1;
    fprintf(out, "{\"monotonic_us\": %llu, \"power_on_us\": %llu}\n",
            next.tv_sec * 1000000ULL + (unsigned long long)next.tv_nsec / 1000,
            (unsigned long long)since_power_on_ns / 1000);
    return fclose(out) != 0;
}
