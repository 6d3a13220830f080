/* A SocketCAN raw socket (Linux, Documentation/networking/can.rst) with the kernel's filters and time stamps, which
 * never blocks the step, and a thread that waits for its interface.
 *
 * The interface may be missing when the block starts. The thread looks for it ten times a second, binds the socket when
 * it appears, also after it was removed, and logs once what is missing and what to do about it. The descriptor stays
 * the same as long as the block lives, so the step can use it at any time.
 */
#ifndef FLOTILLA_CAN_SOCKET_H
#define FLOTILLA_CAN_SOCKET_H

#include "core/socket_queue.h"

#include <flotilla/driver.h>
#include <linux/can.h>
#include <stdatomic.h>

enum { CAN_FILTERS = 8 };

struct can_socket {
    struct fl_block *block;
    const char *interface;
    struct can_filter filters[CAN_FILTERS];
    size_t filter_count;
    struct fl_driver *driver;
    void (*watch)(struct fl_block *block); /* called by the thread at each look; may be NULL */
    void (*end)(struct fl_block *block);   /* called by the thread after can_end, its last work; may be NULL */

    /* Between thread and step. */
    _Atomic int fd;               /* 0 until the kernel has given a socket */
    _Atomic bool up;              /* the interface is there and up, and the socket bound to it */
    _Atomic bool bus_off;         /* the controller is bus-off, until a frame arrives or it reports a restart */
    _Atomic uint32_t connections; /* how often the interface came up */
    int end_fd;                   /* wakes the thread for `end`; 0: there is none */

    /* The thread's. */
    unsigned bound; /* index of the interface; 0: none */
    int logged;     /* the state that was logged last */
};

/* Wait for `interface`, and receive frames that pass one of `filters` (at most CAN_FILTERS, copied), and the
 * controller's own reports. FL_OK, or FL_FAILED after fl_fail(); that the interface is missing is no failure. */
int can_start(struct fl_block *block, struct can_socket *can, const char *interface, const struct can_filter *filters,
              size_t count);

/* The interface is up: what is sent now goes to the bus. For the step. */
bool can_connected(const struct can_socket *can);

/* The next frame that waits, and when the kernel took it from the bus (CLOCK_MONOTONIC). False: none waits, or the
 * interface is down. For the step. */
bool can_receive(struct can_socket *can, struct can_frame *frame, int64_t *arrived_ns);

/* Hand a frame to the controller's queue. False: the queue is full, or the interface is missing or down. For the step,
 * and for `safe`. */
bool can_send(struct can_socket *can, const struct can_frame *frame);

/* Let the thread call `end` at once. For `safe`. */
void can_end(const struct can_socket *can);

/* Wait until the thread has returned. What it has not begun it leaves out. The socket can still send. */
void can_join(struct can_socket *can);

/* Stop the thread and close the socket; after a start that failed halfway, or none, too. */
void can_stop(struct can_socket *can);

#endif
