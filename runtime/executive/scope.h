/* Where clients attach to a running task and detach from it, to be given signals after each step. Neither the control
 * thread nor a client waits for the other. */
#ifndef FLOTILLA_SCOPE_H
#define FLOTILLA_SCOPE_H

#include "sampler.h"

#include <stdatomic.h>

enum {
    SCOPE_CLIENTS = 4,
    SCOPE_ROW_BYTES = 1024, /* of a client's row at most, so that the copies after a step are bounded */
};

struct scope_slot {
    _Alignas(64) _Atomic int state; /* enum in scope.c */
    struct sampler *sampler;
    uint32_t every, until; /* rows: each `every`-th step; steps until the next */
    bool begun;
};

struct scope {
    struct scope_slot slots[SCOPE_CLIENTS];
};

/* Put a row into `sampler` after each step whose number is a multiple of `every`, at least 1. NULL: all slots are
 * taken. For one thread. */
struct scope_slot *scope_attach(struct scope *scope, struct sampler *sampler, uint32_t every);

/* When it returns, the control thread does not use the sampler any more. In any thread. */
void scope_detach(struct scope_slot *slot);

void scope_put_slot(struct scope_slot *slot, uint64_t step, int64_t release_ns);

/* For the control thread, after the step of that number. */
static inline void scope_put(struct scope *scope, uint64_t step, int64_t release_ns)
{
    for (struct scope_slot *slot = scope->slots; slot < scope->slots + SCOPE_CLIENTS; slot++)
        if (atomic_load_explicit(&slot->state, memory_order_relaxed))
            scope_put_slot(slot, step, release_ns);
}

#endif
