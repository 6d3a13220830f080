/* A lock-free queue of fixed-size records from one thread to one other thread. Neither waits. */
#ifndef FLOTILLA_RING_H
#define FLOTILLA_RING_H

#include <flotilla/block.h>

struct fl_ring {
    size_t record;  /* bytes of a record */
    uint32_t count; /* a power of two */
    unsigned char *data;
    _Alignas(64) _Atomic uint32_t head; /* next to put; the producer's */
    _Atomic uint32_t lost;              /* records dropped because the ring was full */
    _Alignas(64) _Atomic uint32_t tail; /* next to take; the consumer's */
};

/* Memory needed for `count` records (a power of two). */
size_t fl_ring_bytes(size_t record, uint32_t count);

void fl_ring_initialize(struct fl_ring *ring, void *memory, size_t record, uint32_t count);

/* False when full: the record is dropped and counted in `lost`. */
bool fl_ring_put(struct fl_ring *ring, const void *record);

/* False when empty. */
bool fl_ring_take(struct fl_ring *ring, void *record);

#endif
