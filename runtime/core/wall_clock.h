#ifndef FLOTILLA_CORE_WALL_CLOCK_H
#define FLOTILLA_CORE_WALL_CLOCK_H

#include <stdint.h>

/* CLOCK_REALTIME minus CLOCK_MONOTONIC, now, in nanoseconds; within 10 us unless all of four readings were interrupted.
 * May be called in a step: where the vDSO provides both clocks, it makes no system call. */
int64_t fl_wall_less_monotonic_ns(void);

#endif
