#ifndef FLOTILLA_SIGNAL_WALL_CLOCK_H
#define FLOTILLA_SIGNAL_WALL_CLOCK_H

#include <stdint.h>

/* CLOCK_REALTIME less CLOCK_MONOTONIC, now, in nanoseconds. The vDSO answers both without entering the kernel. */
int64_t wall_less_monotonic_ns(void);

#endif
