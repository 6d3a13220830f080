/* The slower rates of a block, each in a thread of its own: what generated code of a multitasking model asks for.
 *
 * The block's step is the fastest rate. A slower rate is released in every Nth step of the block, from the first on,
 * after that step has done its own work; it then has N periods until its next release. What goes in and out is copied
 * at releases only, in the thread of the step: `publish` hands out what the last run of the rate made, `latch` takes
 * what the next run is given. So the values of a task do not depend on how long a rate runs, nor on the clock.
 *
 *   start        fl_rates_start
 *   step         fl_rates_begin; parameters may be changed if fl_rates_aligned; the fastest rate; fl_rates_release
 *   terminate    fl_rates_stop, before anything that a rate uses goes
 *
 * With real-time priorities all rates have one processor, and the threads of slower rates run below the priority of
 * drivers and of interrupts, the slower the lower: of the block's code only faster rates interrupt one, which generated
 * code relies on.
 * Otherwise (priority 0, refused, or --no-wait) no scheduler promises this, and fl_rates_release waits for each rate
 * that it releases.
 *
 * A rate that still runs at its next release has overrun: it goes on, that release is left out, and the overrun counts
 * as one of the task's. As many in a row as the task permits (`overruns`; one with `overrun: stop-safe`) end the task.
 * A rate that runs for ten of its periods and a second hangs: outputs go to their reset state, and the process ends.
 */
#ifndef FLOTILLA_RATES_H
#define FLOTILLA_RATES_H

#include <flotilla/block.h>

struct fl_rate {
    const char *name;                        /* in messages */
    uint64_t every;                          /* in every Nth step of the block, at least 2 */
    void (*publish)(struct fl_block *block); /* in the thread of the step, while the rate does not run; NULL: nothing */
    void (*latch)(struct fl_block *block);   /* the same */
    void (*run)(struct fl_block *block);     /* in the rate's thread */
};

/* Start the threads; `rates` begin with the fastest one and have to last as long as the block. FL_FAILED after
 * fl_fail(), also where the priority of the task leaves too few below it. */
int fl_rates_start(struct fl_block *block, const struct fl_rate *rates, uint32_t count);

/* Begin a step: for each rate that is due publish and latch. FL_FAILED after fl_fail() when the task has to end. */
int fl_rates_begin(struct fl_block *block);

/* In a step, whether all rates are due and none runs: what they share may be changed. */
bool fl_rates_aligned(const struct fl_block *block);

/* End a step: release the rates that are due. */
void fl_rates_release(struct fl_block *block);

/* End the threads. A run that does not end within a second ends the process with outputs in their reset state. Nothing
 * happens where there are none. */
void fl_rates_stop(struct fl_block *block);

#endif
