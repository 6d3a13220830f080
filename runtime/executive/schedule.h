/* The blocks that a step calls, in their order of execution, laid out for the cache, with their timing. */
#ifndef FLOTILLA_SCHEDULE_H
#define FLOTILLA_SCHEDULE_H

#include "task.h"

struct schedule;

struct schedule *schedule_create(const struct task *task);
void schedule_destroy(struct schedule *schedule);

/* Step the blocks whose turn it is. Returns NULL, or the block whose step failed; later blocks are not called then.
 * Called in real time, by one thread. */
const struct fl_block *schedule_step(struct schedule *schedule, int64_t release_ns);

/* After the last step: write the timing of each block into the task. */
void schedule_report(const struct schedule *schedule, struct task *task);

#endif
