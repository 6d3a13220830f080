/* The socket of a task or an app that runs here; executive/tuner.h has what is spoken there. */
#ifndef FLOTILLA_TASK_SOCKET_H
#define FLOTILLA_TASK_SOCKET_H

#include <stdbool.h>
#include <stddef.h>

/* Where the service of that name has its socket. False, after a message, when a task and an app have the name. */
bool task_socket_find(const char *name, char *path, size_t size);

/* Connect; -1 after a message that names `task`. */
int task_socket_connect(const char *task, const char *path);

#endif
