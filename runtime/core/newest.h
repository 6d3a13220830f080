/* A triple buffer hands records from one thread to another, where only the newest matters. Neither thread waits: each
 * owns one of three slots and swaps it for the third. A ring would keep the oldest records and drop the newest once a
 * slow step has let it fill up. */
#ifndef FLOTILLA_CORE_NEWEST_H
#define FLOTILLA_CORE_NEWEST_H

#include <flotilla/block.h>
#include <stdatomic.h>

enum { NEWEST_SLOTS = 3 };

struct newest {
    void *slots[NEWEST_SLOTS];
    _Alignas(64) unsigned writing;         /* the producer's slot */
    _Alignas(64) unsigned reading;         /* the consumer's */
    _Alignas(64) _Atomic unsigned between; /* the third, with NEWEST_FRESH until the consumer has swapped it */
};

enum { NEWEST_INDEX = 3, NEWEST_FRESH = 4 };

static inline void newest_begin(struct newest *newest)
{
    newest->writing = 0;
    newest->reading = 1;
    atomic_init(&newest->between, 2);
}

/* Slots of `bytes` each, in memory of the block. FL_OK, or FL_FAILED after fl_fail(). */
static inline int newest_allocate(struct newest *newest, struct fl_block *block, size_t bytes)
{
    newest_begin(newest);
    for (int i = 0; i < NEWEST_SLOTS; i++)
        if (!(newest->slots[i] = fl_allocate(block, bytes)))
            return FL_FAILED;
    return FL_OK;
}

/* The producer's slot, to be filled and then handed over by newest_put. */
static inline void *newest_back(struct newest *newest)
{
    return newest->slots[newest->writing];
}

static inline void newest_put(struct newest *newest)
{
    newest->writing =
        atomic_exchange_explicit(&newest->between, newest->writing | NEWEST_FRESH, memory_order_acq_rel) & NEWEST_INDEX;
}

/* The newest record since the last call, NULL when there is none. It stays as it is until the next call. */
static inline void *newest_take(struct newest *newest)
{
    if (!(atomic_load_explicit(&newest->between, memory_order_relaxed) & NEWEST_FRESH))
        return NULL;
    newest->reading = atomic_exchange_explicit(&newest->between, newest->reading, memory_order_acq_rel) & NEWEST_INDEX;
    return newest->slots[newest->reading];
}

#endif
