/* How a running task does, for whoever asks: its control thread writes, others read, and neither waits for the other.
 *
 * What is read is as of the end of one step. As JSON, one line:
 *
 *     {"task": "heading", "period_s": 0.01, "running_s": 75.21, "steps": 7521, "overruns": 3, "skipped": 4,
 *      "timeouts": 0, "last_overrun": {"step": 5000, "ago_s": 25.2, "late_s": 0.0012},
 *      "sensors": {"gyro": {"flag": true, "age_s": 0.004}}}
 *
 *   running_s     since the first step was prepared: all counts begin there, and end with the task
 *   overruns      steps that ended after the next one was due; `skipped` releases were left out because of them
 *   timeouts      steps for which the task's trigger had nothing
 *   last_overrun  null: there was none; `late_s`: how long after the next one was due its step ended
 *   sensors       all blocks with the outputs that flotilla/sensor.h defines, of plug-ins too
 */
#ifndef FLOTILLA_STATUS_H
#define FLOTILLA_STATUS_H

#include "executive.h"

struct status;

struct status *status_create(const struct task *task);
void status_destroy(struct status *status); /* NULL is allowed */

/* After each step, which ended at `now_ns`, by the control thread, in real time: the counts of `result`, and the
 * sensors' outputs. */
void status_put(struct status *status, const struct run_result *result, int64_t now_ns);

/* Steps done, and when the last one ended, CLOCK_MONOTONIC; before the first: when it is to be expected. */
uint64_t status_steps(const struct status *status);
int64_t status_ended_ns(const struct status *status);

/* As a line of JSON, or as lines for people. Not for the control thread. */
void status_write(const struct status *status, bool json, FILE *out);

#endif
