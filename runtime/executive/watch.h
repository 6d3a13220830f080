/* Signals that are printed while a task runs: copied by the control thread, printed by another. */
#ifndef FLOTILLA_WATCH_H
#define FLOTILLA_WATCH_H

#include "executive.h"

struct watch;

struct watch *watch_create(const struct watched *watched, size_t count);
void watch_destroy(struct watch *watch); /* NULL is allowed */

/* Copy the signals as they are; with `wait` until there is room (not in real time), otherwise dropped when there is
 * none. */
void watch_put(struct watch *watch, uint64_t step, int64_t release_ns, bool wait);

/* Print what has come: {"step": 0, "release_ns": 0, "lost": 0, "block.port": 1.5}. 0, or an errno once
 * something could not be printed. */
int watch_print(struct watch *watch);

#endif
