/* A SocketCAN raw socket (Linux, Documentation/networking/can.rst) that never blocks, with the kernel's filters and
 * time stamps. */
#ifndef FLOTILLA_CAN_SOCKET_H
#define FLOTILLA_CAN_SOCKET_H

#include <flotilla/block.h>
#include <linux/can.h>

struct can_socket {
    int fd;
    bool bus_off; /* the controller left the bus; until a frame arrives or it says that it was restarted */
};

/* Open `interface` for frames that pass one of the filters, and for the controller's own reports. FL_OK, or FL_FAILED
 * after fl_fail(). The bus need not be up: it may come and go while the socket stays. */
int can_open(struct fl_block *block, struct can_socket *can, const char *interface, const struct can_filter *filters,
             size_t count);

/* The next frame that waits, and when the kernel took it from the bus (CLOCK_MONOTONIC). False: none waits. */
bool can_receive(struct can_socket *can, struct can_frame *frame, int64_t *arrived_ns);

/* Hand a frame to the controller's queue. False: the queue is full, or the interface is down. */
bool can_send(const struct can_socket *can, const struct can_frame *frame);

/* After a start that failed halfway too: a descriptor of 0 was never opened, for a state begins as zeros. */
void can_close(struct can_socket *can);

#endif
