/* A run of a task: what is asked of it, and what came of it. */
#ifndef FLOTILLA_RUN_H
#define FLOTILLA_RUN_H

#include "statistics.h"

#include <flotilla/block.h>

struct tuner;

enum ending {
    ENDING_NONE,
    ENDING_ASKED,   /* a signal, or all steps are done */
    ENDING_DONE,    /* a block's fl_end() */
    ENDING_FAILED,  /* a block's start, initialize or step */
    ENDING_OVERRUN, /* overrun policy stop-safe, or too many in a row */
};

struct watched {
    const char *name; /* "block.port" as the user wrote it */
    const void *signal;
    enum fl_type type;
    uint32_t width;
};

struct run_options {
    uint64_t steps;                /* end after that many; 0: never */
    bool no_wait;                  /* do not wait for releases: count time instead of measuring it */
    const struct watched *watched; /* print them each step as a line of JSON on stdout */
    size_t watched_count;
    bool service; /* by the service manager: actuators wait for a command that is off, unless the task says otherwise */
    struct tuner *tuner; /* serves while the task runs; NULL: parameters stay as they are */
};

struct run_result {
    enum ending ending;
    char reason[320];
    bool safe;          /* all outputs are in their reset state */
    char outputs[1024]; /* which are, and which are not and why */
    uint64_t steps, overruns;
    uint64_t skipped; /* releases without a step */
    struct overrun_of_step {
        uint64_t step;
        int64_t at_ns, late_ns; /* when it ended, CLOCK_MONOTONIC, and how long after the next was due */
    } last_overrun;             /* where there were overruns */
    uint64_t timeouts;          /* steps without a trigger event */
    struct statistics jitter;   /* from a step's release to its begin */
    struct statistics step;     /* from begin to end */
};

#endif
