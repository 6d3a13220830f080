/* A running task's parameters, read and set, and how it does, through a Unix stream socket, of which flotilla-param is
 * the other end.
 *
 * A connection carries one request, a line of text:
 *
 *     list                           all parameters
 *     get BLOCK.PARAMETER
 *     set BLOCK.PARAMETER VALUE      as a task file writes it; only what is tunable (FL_TUNABLE)
 *     status                         steps, overruns, sensors' flags: lines for people
 *     status json                    the same, as status.h describes it
 *
 * and its answer, until the task closes it: "ok" on a line and what was asked for on the following ones, or "error",
 * with the reason on the next line. A value is judged as in a task file, together with the block's other ones, taken
 * between two steps, and logged with the user who set it. A request has two seconds to arrive and its answer to leave.
 *
 * All is done by one thread of ordinary priority; the control thread never waits for it.
 */
#ifndef FLOTILLA_TUNER_H
#define FLOTILLA_TUNER_H

#include "change.h"
#include "task.h"

struct status;
struct tuner;

/* Listen at `path`, for the user of this process alone. A socket that a killed task left behind is replaced. NULL after
 * a message on stderr. */
struct tuner *tuner_create(const char *path, struct task *task);

/* Close and remove the socket. NULL is allowed. */
void tuner_destroy(struct tuner *tuner);

/* Start serving; `status` is the task's. 0 or an errno. From then on the control thread takes what is offered in
 * tuner_change(). */
int tuner_start(struct tuner *tuner, const struct status *status);
struct change *tuner_change(struct tuner *tuner);

/* End serving; nothing that a client does delays it. */
void tuner_stop(struct tuner *tuner);

#endif
