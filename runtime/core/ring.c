#include <flotilla/ring.h>
#include <stdatomic.h>
#include <string.h>

size_t fl_ring_bytes(size_t record, uint32_t count)
{
    return record * count;
}

void fl_ring_initialize(struct fl_ring *ring, void *memory, size_t record, uint32_t count)
{
    ring->record = record;
    ring->count = count;
    ring->data = memory;
    atomic_init(&ring->head, 0);
    atomic_init(&ring->tail, 0);
    atomic_init(&ring->lost, 0);
}

/* Head and tail run freely and wrap at 2^32, a multiple of every count: their difference is how many wait. */
bool fl_ring_put(struct fl_ring *ring, const void *record)
{
    uint32_t head = atomic_load_explicit(&ring->head, memory_order_relaxed);
    uint32_t tail = atomic_load_explicit(&ring->tail, memory_order_acquire);
    if (head - tail == ring->count) {
        atomic_fetch_add_explicit(&ring->lost, 1, memory_order_relaxed);
        return false;
    }
    memcpy(ring->data + (head & (ring->count - 1)) * ring->record, record, ring->record);
    atomic_store_explicit(&ring->head, head + 1, memory_order_release);
    return true;
}

bool fl_ring_take(struct fl_ring *ring, void *record)
{
    uint32_t tail = atomic_load_explicit(&ring->tail, memory_order_relaxed);
    uint32_t head = atomic_load_explicit(&ring->head, memory_order_acquire);
    if (head == tail)
        return false;
    memcpy(record, ring->data + (tail & (ring->count - 1)) * ring->record, ring->record);
    atomic_store_explicit(&ring->tail, tail + 1, memory_order_release);
    return true;
}
