#define _GNU_SOURCE
#include "sync.h"

#include <stddef.h>
#include <stdio.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

void can_sync_claim(struct can_sync *sync, const char *interface)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX}; /* abstract: the path begins with a zero */
    int length = snprintf(address.sun_path + 1, sizeof address.sun_path - 1, "flotilla-can-sync/%s", interface);
    if (atomic_load(&sync->mine))
        return;
    if (sync->fd <= 0)
        sync->fd = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    socklen_t size = (socklen_t)(offsetof(struct sockaddr_un, sun_path) + 1) + (socklen_t)length;
    atomic_store(&sync->mine, sync->fd > 0 && bind(sync->fd, (struct sockaddr *)&address, size) == 0);
}

void can_sync_release(struct can_sync *sync)
{
    atomic_store(&sync->mine, false);
    if (sync->fd > 0)
        close(sync->fd);
    sync->fd = 0;
}
