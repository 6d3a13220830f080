#define _GNU_SOURCE
#include "task_socket.h"

#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

int task_socket_connect(const char *task, const char *path)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    size_t length = strlen(path);
    int fd = -1;
    if (length >= sizeof address.sun_path)
        errno = ENAMETOOLONG;
    else if ((fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0)) >= 0) {
        memcpy(address.sun_path, path, length);
        if (connect(fd, (struct sockaddr *)&address, sizeof address) == 0)
            return fd;
    }
    if (errno == ENOENT || errno == ECONNREFUSED)
        fprintf(stderr, "%s: no task %s runs here: nobody listens at %s\n", program_invocation_short_name, task, path);
    else if (errno == EACCES)
        fprintf(stderr, "%s: %s: task %s answers the user that it runs as, that user's group, and root only\n",
                program_invocation_short_name, path, task);
    else
        fprintf(stderr, "%s: %s: %s\n", program_invocation_short_name, path, strerror(errno));
    return -1;
}

/* Where services have their sockets: control tasks, and apps. */
static const char *const directories[] = {"/run/flotilla", "/run/flotilla-apps"};

bool task_socket_find(const char *name, char *path, size_t size)
{
    char other[PATH_MAX];
    snprintf(path, size, "%s/%s/control", directories[0], name);
    snprintf(other, sizeof other, "%s/%s/control", directories[1], name);
    if (access(other, F_OK) < 0)
        return true;
    if (access(path, F_OK) == 0) {
        fprintf(stderr, "%s: a control task and an app are named %s: say which by --control %s or %s\n",
                program_invocation_short_name, name, path, other);
        return false;
    }
    snprintf(path, size, "%s", other);
    return true;
}
