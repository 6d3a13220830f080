/* Brings outputs to their reset state and keeps them there, however the task ends: a step that never ends, a fatal
 * signal, abort() or exit() in a block.
 *
 * First the thread that steps is parked: it waits in a signal handler until the process has died, so no step writes an
 * actuator after `safe`. Then `safe` of each block is called, and the process ends. It ends in any case one second
 * after this began.
 *
 * Of a crash, stderr gets the block, the signal and the place in the code, once outputs are safe.
 *
 * A process is not notified of SIGKILL, of _exit(), or of being killed for want of memory. Then outputs keep their
 * state until the actuator's own time-out, or until the service manager runs `flotilla-run --safe`.
 *
 * Signals belong to the process, so a process runs one task at a time.
 */
#ifndef FLOTILLA_SAFETY_H
#define FLOTILLA_SAFETY_H

#include "task.h"

#include <signal.h>

/* From now on until safety_end(), the started blocks of `task` are made safe. An error or a lack of memory here ends
 * the process: nothing runs yet. */
void safety_begin(struct task *task);
void safety_end(void);

/* The block whose code the calling thread runs, for the report of a crash. */
extern _Thread_local const struct fl_block *safety_running;

/* The calling thread begins to step, or stops, so that it need not be parked. */
void safety_step_begin(void);
void safety_step_end(void);

/* `terminate` of a block begins, which has started: the process ends if it takes too long. Outputs are safe by then. */
void safety_terminates(const struct fl_block *block);

/* Call `safe` of a block that has started and has one. */
void safety_reset(const struct task_block *task_block);

/* Whether the outputs of all actuators are in their reset state, as far as is known; writes for the user which are, and
 * which are not and why. In signal handlers, too. */
bool safety_outcome(const struct task *task, char *out, size_t size);

enum { SAFETY_OUTCOME = 1024, SAFETY_UNKNOWN = 4 /* status of a process that leaves an output in another state */ };

/* Make outputs safe, write `text` and their state to stderr, and end the process with status 1 or SAFETY_UNKNOWN. None
 * of this can block: text that stderr does not accept is lost. From any thread. */
_Noreturn void safety_abandon(const char *text);

/* All signals that would end or stop the process and can wait for an orderly end of the task: all but the fatal ones,
 * SIGPIPE, which the program ignores, and those that cannot be blocked. */
void safety_orderly_signals(sigset_t *signals);

#endif
