/* Allows one run of a task at a time. The lock is on the task file itself, so a process that dies leaves nothing
 * behind. */
#ifndef FLOTILLA_INSTANCE_H
#define FLOTILLA_INSTANCE_H

/* Lock `path` until the process ends: 0, or the process that holds it, or -1 with errno. */
int instance_lock(const char *path);

#endif
