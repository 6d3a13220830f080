/* What a step of a task calls, in the order of its execution: laid out for the cache, with the times it took. */
#ifndef FLOTILLA_SCHEDULE_H
#define FLOTILLA_SCHEDULE_H

#include "task.h"

struct schedule;

struct schedule *schedule_create(const struct task *task);
void schedule_destroy(struct schedule *schedule);

/* Step the blocks that have their turn. NULL, or the block whose step failed, after which none was called. In real
 * time, by one thread. */
const struct fl_block *schedule_step(struct schedule *schedule, int64_t release_ns);

/* What the blocks took, to the task's members: after the last step. */
void schedule_report(const struct schedule *schedule, struct task *task);

#endif
