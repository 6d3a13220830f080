#include "frames.h"

#include <stdatomic.h>

enum { INDEX = 3, FRESH = 4 }; /* of `between`: which buffer, and whether the consumer has not seen it */

int frames_allocate(struct fl_block *block, struct frames *frames, size_t bytes)
{
    for (size_t i = 0; i < 3; i++)
        if (!(frames->buffers[i].pixels = fl_allocate(block, bytes)))
            return FL_FAILED;
    frames->writing = 0;
    frames->reading = 1;
    atomic_init(&frames->between, 2);
    return FL_OK;
}

uint8_t *frames_back(struct frames *frames)
{
    return frames->buffers[frames->writing].pixels;
}

void frames_publish(struct frames *frames, int64_t at_ns)
{
    struct frame *frame = &frames->buffers[frames->writing];
    frame->at_ns = at_ns;
    frame->sequence = ++frames->written;
    frames->writing = atomic_exchange_explicit(&frames->between, frames->writing | FRESH, memory_order_acq_rel) & INDEX;
}

const struct frame *frames_newest(struct frames *frames)
{
    if (!(atomic_load_explicit(&frames->between, memory_order_relaxed) & FRESH))
        return NULL;
    frames->reading = atomic_exchange_explicit(&frames->between, frames->reading, memory_order_acq_rel) & INDEX;
    return &frames->buffers[frames->reading];
}
