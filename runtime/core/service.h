/* The runtime's side of a block: its memory, its last failure, the priority of its threads. */
#ifndef FLOTILLA_SERVICE_H
#define FLOTILLA_SERVICE_H

#include <flotilla/block.h>
#include <pthread.h>
#include <stdatomic.h>

enum {
    FL_FAILURE_BYTES = 256,
    FL_CACHE_LINE = 64, /* bytes; rings keep their two ends on lines of their own */
};

/* Of an actuator, for a command that is off (fl_may_act). */
enum fl_wait { FL_WAIT_NOT, FL_WAIT_BEGUN /* it has not asked yet */, FL_WAITS };

struct fl_memory {
    struct fl_memory *next;
};

struct fl_bounds {
    bool given; /* by the task file */
    double least, greatest;
};

struct fl_service {
    struct fl_memory *memory;
    char failure[FL_FAILURE_BYTES];
    bool ended;      /* by fl_end() */
    atomic_int wait; /* enum fl_wait */

    /* What is known of an actuator's outputs at the end; several threads may make them safe. */
    _Atomic(const char *) not_safe; /* why they may not be in their reset state; NULL: no reason is known */
    atomic_bool made_safe;          /* `safe` has returned */
    bool *wired;                    /* which inputs are */
    bool *given;                    /* which parameters the task file sets */
    struct fl_bounds *bounds;       /* of each parameter while the task runs */
    _Atomic uint32_t lost;          /* how often the block's serial port has lost bytes (an overrun) */
    int priority;                   /* SCHED_FIFO of the block's threads; 0: ordinary */
    int patience_ms;                /* how long to wait for a device that another process holds */
    int claim_fd;                   /* holds the block's device (device.h); below 1: none */
    struct fl_port *in_ports, *out_ports;
    size_t near_used; /* of the bytes beside the block */

    /* Blocks inside this one (flotilla/inner.h), which the executive keeps. */
    struct registry *registry;                           /* where their types are looked for; NULL: it can have none */
    struct fl_inner *inner;                              /* the last one first */
    void (*destroy_inner)(const struct fl_block *outer); /* NULL: it has none */
    bool inner_failed;

    /* The block's slower rates (flotilla/rates.h), which the executive keeps. */
    struct fl_rates *rates;                          /* NULL: it has none */
    bool rates_in_turn;                              /* each run ends before the step does */
    int64_t overruns;                                /* so many in a row of one rate end the task; 0: never */
    void (*overran)(void *context, int64_t late_ns); /* counts one; in the thread of the step */
    void *overran_context;
    bool overrun_ends; /* why the step failed */
};

/* Of a line of the journal (syslog(3)). */
enum { FL_ERROR = 3, FL_WARNING = 4, FL_INFO = 6 };

/* For a program whose standard error may be the journal; before its first line. */
void fl_priority_begin(void);

/* What a line on the standard error begins with: its priority where that is the journal (sd-daemon(3)), else nothing.
 * In signal handlers, too. */
const char *fl_priority(int priority);

/* Whether an output's type and width go with its flags. */
bool fl_output_possible(const struct fl_port *port);

/* Call enter(argument) with a stack beside it for signal handlers, so that they can run when the own stack of the
 * thread is used up. */
void *fl_service_enter(void *(*enter)(void *), void *argument);

/* Start a thread named after the block, at the service's priority where that is allowed; 0 or an errno. */
int fl_service_thread(struct fl_service *service, pthread_t *thread, const char *name, void *(*enter)(void *),
                      void *argument);

#endif
