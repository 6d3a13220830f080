/* Outputs in their reset state, and held there, however the task ends: by a step that never does, a fatal signal,
 * abort() or exit() in a block's code.
 *
 * What makes outputs safe first parks the thread that steps: it waits in a signal handler until the process has died,
 * so no step of it writes an actuator after `safe`. Then it calls `safe` of each block, and the process ends. A second
 * from the first of these the process ends in any case.
 *
 * Not even the kernel tells a process of SIGKILL, _exit() or the memory that ran out. Then outputs keep their state
 * until the actuator's own time-out, or until the service manager runs `flotilla-run --safe`.
 *
 * Signals belong to the process, so there is one task at a time.
 */
#ifndef FLOTILLA_SAFETY_H
#define FLOTILLA_SAFETY_H

#include "task.h"

#include <signal.h>

/* From now on until safety_end(), the started blocks of `task` are made safe. Memory allocation and errors end the
 * process: nothing runs yet. */
void safety_begin(struct task *task);
void safety_end(void);

/* The calling thread begins to step; or ends to, so that it need not be parked. */
void safety_step_begin(void);
void safety_step_end(void);

/* Make outputs safe, write `text` to stderr and end the process with status 1, none of which can be held up: text that
 * stderr does not take is lost. From any thread. */
_Noreturn void safety_abandon(const char *text);

/* All signals that would end or stop the process and may wait until the task ends in order: all but the fatal ones,
 * SIGPIPE, which the program ignores, and those that cannot be blocked. */
void safety_orderly_signals(sigset_t *signals);

#endif
