/* Allows one run of a task at a time. The lock is on the task file itself, so a process that dies leaves nothing
 * behind. */
#ifndef FLOTILLA_INSTANCE_H
#define FLOTILLA_INSTANCE_H

/* Lock `path` until the process ends: 0, or the process that holds it, or -1 with errno.
 *
 * Whoever may read the file can lock it, also an app or another task that somebody has taken over, and could keep a
 * service from starting again. So what runs as a user below 1000, other than root, heeds a lock of its own user, of
 * root and of users who can log in, and gives 0 where another has it. Everybody else heeds each lock. */
int instance_lock(const char *path);

#endif
