/* How much waits at a socket of a block. The kernel keeps what came first, and drops the newest once the queue is full;
 * so a step takes all that waits, and the queue is so short that it can. */
#ifndef FLOTILLA_CORE_SOCKET_QUEUE_H
#define FLOTILLA_CORE_SOCKET_QUEUE_H

#include <stdbool.h>
#include <sys/socket.h>

enum {
    SOCKET_QUEUE = 128 * 1024, /* bytes; the kernel doubles it (socket(7), SO_RCVBUF) */
    SOCKET_LEAST = 512,        /* bytes that the kernel charges for a datagram or a frame, at least */
    /* Most that one step takes: all that can wait. */
    SOCKET_BURST = 2 * SOCKET_QUEUE / SOCKET_LEAST,
};

/* False with errno. */
static inline bool socket_bound_queue(int fd)
{
    static const int bytes = SOCKET_QUEUE;
    return setsockopt(fd, SOL_SOCKET, SO_RCVBUF, &bytes, sizeof bytes) == 0;
}

#endif
