/* Reads and sets parameters of a running task, reports its state, and streams its signals, through a Unix stream
 * socket. flotilla-param and flotilla-scope are the clients.
 *
 * A connection carries one request, a line of text:
 *
 *     list                           all parameters
 *     get BLOCK.PARAMETER
 *     set BLOCK.PARAMETER VALUE      as a task file has it; only tunable parameters (FL_TUNABLE)
 *     confirm BLOCK.PARAMETER OLD VALUE   of a limit of safety (FL_SAFETY) that is OLD now; `set` refuses it
 *     status                         steps, overruns, flags of sensors: lines for people
 *     status json                    the same, as status.h describes it
 *     signals                        all outputs of blocks, a line each: BLOCK.PORT TYPE ELEMENTS [UNIT]
 *     watch [OPTION...] SIGNAL...    rows of signals until the client goes, as stream.h describes it
 *
 * The answer lasts until the task closes the connection: "ok" on a line and the result on the following ones, or
 * "error" and the reason on the next line. A value is checked as in a task file, together with the other values of the
 * block, taken between two steps, and logged with the user who set it. Request and answer have two seconds each.
 *
 * One thread of ordinary priority does all of this, and one more for each client that watches signals; the control
 * thread never waits for them.
 */
#ifndef FLOTILLA_TUNER_H
#define FLOTILLA_TUNER_H

#include "change.h"
#include "scope.h"
#include "task.h"

struct status;
struct tuner;

/* Listen at `path`, accessible to the user of this process alone. A socket that a killed task left behind is replaced.
 * NULL after a message on stderr. */
struct tuner *tuner_create(const char *path, struct task *task);

/* Close and remove the socket. NULL is allowed. */
void tuner_destroy(struct tuner *tuner);

/* Start serving; `status` is that of the task. 0 or an errno. From then on the control thread takes the values offered
 * in tuner_change(), and puts
 * rows into tuner_scope(). */
int tuner_start(struct tuner *tuner, const struct status *status);
struct change *tuner_change(struct tuner *tuner);
struct scope *tuner_scope(struct tuner *tuner);

/* Stop serving; no client can delay this. */
void tuner_stop(struct tuner *tuner);

#endif
