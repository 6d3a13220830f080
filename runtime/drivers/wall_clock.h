#ifndef FLOTILLA_DRIVERS_WALL_CLOCK_H
#define FLOTILLA_DRIVERS_WALL_CLOCK_H

#include <stdint.h>

/* CLOCK_REALTIME less CLOCK_MONOTONIC, now, in nanoseconds, within 10 us unless all of four readings were interrupted.
 * Where the vDSO answers both, the kernel is not entered. For steps, too. */
int64_t wall_less_monotonic_ns(void);

#endif
