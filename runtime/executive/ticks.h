/* A clock for what a block takes: the processor's time stamp counter, which costs a third of a call for the time.
 *
 * What it counts is known only at the end: two readings of it beside CLOCK_MONOTONIC, as far apart as the run is long,
 * make its unit. Where the counter cannot be trusted, ticks are nanoseconds of CLOCK_MONOTONIC.
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

/* Whether the counter goes at one rate: the kernel keeps time by it, or the processor says so. */
bool ticks_constant(void);

/* Now; `counter` as ticks_constant() says. Not serialised: what is measured is moved by some instructions, not lost. */
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
