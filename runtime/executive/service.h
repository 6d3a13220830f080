/* The executive's side of a block: its memory, its last failure, the priority of its threads. */
#ifndef FLOTILLA_SERVICE_H
#define FLOTILLA_SERVICE_H

#include <flotilla/block.h>
#include <pthread.h>

enum { FL_FAILURE_BYTES = 256 };

struct fl_memory {
    struct fl_memory *next;
};

struct fl_service {
    struct fl_memory *memory;
    char failure[FL_FAILURE_BYTES];
    int priority;    /* SCHED_FIFO of the block's threads; 0: ordinary */
    int patience_ms; /* how long to wait for a device that another process holds */
    int claim_fd;    /* holds the block's device (device.h); below 1: none */
    struct fl_port *in_ports, *out_ports;
    size_t near_used;          /* of the bytes beside the block */
    struct registry *registry; /* where inner blocks are looked for; NULL: it can have none */
    struct fl_inner *inner;    /* its inner blocks (flotilla/inner.h), the last one first */
    bool inner_failed;
};

/* enter(argument), with a stack beside it for handlers of signals, so that they run when the thread's own is used up.
 */
void *fl_service_enter(void *(*enter)(void *), void *argument);

/* Start a thread named after the block, at the service's priority where that is allowed; 0 or an errno. */
int fl_service_thread(struct fl_service *service, pthread_t *thread, const char *name, void *(*enter)(void *),
                      void *argument);

#endif
