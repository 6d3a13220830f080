/* Prints signals while a task runs: the control thread copies them, another thread prints them. */
#ifndef FLOTILLA_WATCH_H
#define FLOTILLA_WATCH_H

#include "run.h"
#include "task.h"

struct watch;

struct watch *watch_create(const struct watched *watched, size_t count);
void watch_destroy(struct watch *watch); /* NULL is allowed */

/* Copy the present values. With `wait`: wait until there is room (not in real time); otherwise drop them when there is
 * none. */
void watch_put(struct watch *watch, uint64_t step, int64_t release_ns, bool wait);

/* Print the copies: {"step": 0, "release_ns": 0, "lost": 0, "block.port": 1.5}. 0, or an errno when printing has
 * failed. */
int watch_print(struct watch *watch);

#endif
