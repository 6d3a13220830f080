/* The state of a running task: the control thread writes it, others read it, and neither waits for the other.
 *
 * A reading is as of the end of one step. As JSON, one line:
 *
 *     {"task": "heading", "period_s": 0.01, "running_s": 75.21, "steps": 7521, "overruns": 3, "skipped": 4,
 *      "timeouts": 0, "last_overrun": {"step": 5000, "ago_s": 25.2, "late_s": 0.0012},
 *      "sensors": {"gyro": {"flag": true, "age_s": 0.004}},
 *      "refused": {"wrench": {"refused": 5, "forged": 410, "replayed": 206}},
 *      "serial_overruns": {"gyro": 12}, "waiting": ["relays"]}
 *
 *   running_s     since the first step was prepared; all counts begin there
 *   overruns      steps that ended after the next one was due; they led to `skipped` releases without a step
 *   timeouts      steps without a trigger event
 *   last_overrun  null: there was none; `late_s`: how long after the next one was due the step ended
 *   sensors       all blocks with the outputs that flotilla/sensor.h defines, of plug-ins too
 *   refused       by block, the outputs with FL_REFUSALS that are not 0, of plug-ins too
 *   serial_overruns  by block, how often its serial port has lost bytes, if ever: in the UART or in the kernel's buffer
 *   waiting       actuators that wait for a command that is off
 */
#ifndef FLOTILLA_STATUS_H
#define FLOTILLA_STATUS_H

#include "run.h"
#include "task.h"

struct status;

struct status *status_create(const struct task *task);
void status_destroy(struct status *status); /* NULL is allowed */

/* For the control thread, after each step, which ended at `now_ns`, in real time: store the counts of `result` and the
 * outputs of the sensors and of what was refused. */
void status_put(struct status *status, const struct run_result *result, int64_t now_ns);

/* Steps done, and when the last one ended (CLOCK_MONOTONIC); before the first step: when it is expected. */
uint64_t status_steps(const struct status *status);
int64_t status_ended_ns(const struct status *status);

/* As a line of JSON, or as lines for people. Not for the control thread. */
void status_write(const struct status *status, bool json, FILE *out);

#endif
