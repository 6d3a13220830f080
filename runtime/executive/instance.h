/* One run of a task at a time: the file itself is the lock, so nothing stays behind when the process dies. */
#ifndef FLOTILLA_INSTANCE_H
#define FLOTILLA_INSTANCE_H

/* Lock `path` until the process ends: 0, or the process that holds it, or -1 with errno. */
int instance_lock(const char *path);

#endif
