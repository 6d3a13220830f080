#ifndef FLOTILLA_CORE_WALL_CLOCK_H
#define FLOTILLA_CORE_WALL_CLOCK_H

#include <stdint.h>
#include <time.h>

/* A clock in nanoseconds. One that cannot be read ends the process, with outputs safe. */
int64_t fl_clock_ns(clockid_t clock);

/* CLOCK_REALTIME minus CLOCK_MONOTONIC, now, in nanoseconds; within 10 us unless all of four readings were interrupted.
 * May be called in a step: where the vDSO provides both clocks, it makes no system call. */
int64_t fl_wall_less_monotonic_ns(void);

#endif
