#include "scope.h"

#include <sched.h>

enum { FREE, ATTACHED, COPYING };

struct scope_slot *scope_attach(struct scope *scope, struct sampler *sampler, uint32_t every)
{
    for (struct scope_slot *slot = scope->slots; slot < scope->slots + SCOPE_CLIENTS; slot++) {
        if (atomic_load_explicit(&slot->state, memory_order_acquire) != FREE)
            continue;
        slot->sampler = sampler;
        slot->every = every;
        slot->begun = false;
        atomic_store_explicit(&slot->state, ATTACHED, memory_order_release);
        return slot;
    }
    return NULL;
}

void scope_detach(struct scope_slot *slot)
{
    int attached = ATTACHED;
    while (!atomic_compare_exchange_weak_explicit(&slot->state, &attached, FREE, memory_order_acq_rel,
                                                  memory_order_relaxed)) {
        attached = ATTACHED;
        sched_yield(); /* a row is being copied at this moment */
    }
}

void scope_put_slot(struct scope_slot *slot, uint64_t step, int64_t release_ns)
{
    int attached = ATTACHED;
    if (!atomic_compare_exchange_strong_explicit(&slot->state, &attached, COPYING, memory_order_acquire,
                                                 memory_order_relaxed))
        return;
    if (!slot->begun) { /* a division each step would be slow */
        slot->until = (slot->every - (uint32_t)(step % slot->every)) % slot->every;
        slot->begun = true;
    }
    if (slot->until-- == 0) {
        slot->until = slot->every - 1;
        sampler_put(slot->sampler, step, release_ns, false);
    }
    atomic_store_explicit(&slot->state, ATTACHED, memory_order_release);
}
