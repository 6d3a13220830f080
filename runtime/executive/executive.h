/* Runs a task: start and initialize all blocks, step them in real time, leave outputs in their reset state.
 *
 * The steps run in a thread of their own (SCHED_FIFO at the task's priority), released at absolute times or by the
 * task's trigger. The caller's thread serves: signals, the service manager's watchdog, what is to be printed. Another
 * guards the control thread, one priority above it, so that a step that never ends neither keeps outputs as they are
 * nor a computer with one processor to itself: a task cannot hang.
 */
#ifndef FLOTILLA_EXECUTIVE_H
#define FLOTILLA_EXECUTIVE_H

#include "statistics.h"
#include "task.h"
#include "tuner.h"

#include <stdbool.h>
#include <stdio.h>

enum ending {
    ENDING_NONE,
    ENDING_ASKED,   /* a signal, or all steps done */
    ENDING_FAILED,  /* a block's start, initialize or step */
    ENDING_OVERRUN, /* overrun policy stop-safe, or too many in a row */
};

struct watched {
    const char *name; /* "block.port" as it was asked for */
    const void *signal;
    enum fl_type type;
    uint32_t width;
};

struct run_options {
    uint64_t steps;                /* end after that many; 0: never */
    bool no_wait;                  /* do not wait for a release: time is counted, not measured */
    const struct watched *watched; /* print them each step as a line of JSON on stdout */
    size_t watched_count;
    struct tuner *tuner; /* serves while the task runs; NULL: parameters stay as they are */
};

struct run_result {
    enum ending ending;
    char reason[320];
    uint64_t steps, overruns;
    uint64_t skipped; /* releases that were left out */
    struct overrun_of_step {
        uint64_t step;
        int64_t at_ns, late_ns; /* when it ended, CLOCK_MONOTONIC, and how long after the next was due */
    } last_overrun;             /* where there were overruns */
    uint64_t timeouts;          /* steps for which the trigger had nothing */
    struct statistics jitter;   /* from a step's release to its begin */
    struct statistics step;     /* from begin to end */
};

/* Run until it ends; the blocks are terminated and the result is complete then. Messages go to stderr. */
void executive_run(struct task *task, const struct run_options *options, struct run_result *result);

/* Bring all outputs to their reset state without a step: for after a task that was killed. What another process still
 * holds after a second is left alone. Number of failures. */
unsigned executive_make_safe(struct task *task);

/* Steps, overruns and times of task and blocks as JSON. */
void executive_write_statistics(const struct task *task, const struct run_result *result, FILE *out);

#endif
