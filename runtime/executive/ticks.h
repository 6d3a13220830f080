/* A clock for the timing of blocks: the processor's time stamp counter, which costs a third of a system clock reading.
 *
 * The counter's unit is computed at the end, from two readings of it beside CLOCK_MONOTONIC at the begin and the end of
 * the run. Where the counter is not reliable, ticks are nanoseconds of CLOCK_MONOTONIC.
 */
#ifndef FLOTILLA_TICKS_H
#define FLOTILLA_TICKS_H

#include <flotilla/block.h>

#if defined(__x86_64__) || defined(__i386__)
#include <x86intrin.h>
#endif

/* Both clocks at one moment. */
struct moment {
    int64_t ticks, ns;
};

/* Whether the counter runs at a constant rate: the kernel uses it as its clock, or the processor reports it as
 * invariant. */
bool ticks_constant(void);

/* The current time in ticks; `counter` is the result of ticks_constant(). The reading is not serialised, so a boundary
 * between blocks may move by some instructions. */
static inline int64_t ticks_now(bool counter)
{
#if defined(__x86_64__) || defined(__i386__)
    if (counter)
        return (int64_t)__rdtsc();
#else
    (void)counter;
#endif
    return fl_now_ns();
}

struct moment ticks_moment(bool counter);

/* Nanoseconds of a tick between two moments; 1 where none passed. */
double ticks_ns(struct moment begin, struct moment end);

#endif
