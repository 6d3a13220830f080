/* Runs a task: starts and initializes all blocks, steps them in real time, leaves outputs in their reset state.
 *
 * The steps run in a control thread (SCHED_FIFO at the task's priority), released at absolute times or by the task's
 * trigger. The caller's thread serves signals, the service manager's watchdog, and printing. A guard thread, one
 * priority above the control thread, ends the process when a step does not end. So a task cannot hang, hold its
 * outputs, or keep a single processor busy for ever.
 */
#ifndef FLOTILLA_EXECUTIVE_H
#define FLOTILLA_EXECUTIVE_H

#include "run.h"
#include "task.h"

#include <stdio.h>

/* Run the task until it ends. Then the blocks are terminated and the result is complete. Messages go to stderr. */
void executive_run(struct task *task, const struct run_options *options, struct run_result *result);

/* Bring all outputs to their reset state without a step, after a task was killed. A device that another process still
 * holds after a second is left as it is. Whether all are in it; otherwise stderr has which are not, and why. */
bool executive_make_safe(struct task *task);

/* Steps, overruns and times of task and blocks as JSON. `last_overrun` is null where there was none; its `step` ended
 * at `at_ns` of CLOCK_MONOTONIC, `late_ns` after the next one was due. */
void executive_write_statistics(const struct task *task, const struct run_result *result, FILE *out);

#endif
