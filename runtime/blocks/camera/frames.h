/* A triple buffer hands frames from one thread to another, where only the newest matters. Neither thread waits: each
 * owns one of three buffers and swaps it for the third. */
#ifndef FLOTILLA_CAMERA_FRAMES_H
#define FLOTILLA_CAMERA_FRAMES_H

#include <flotilla/block.h>

struct frame {
    uint8_t *pixels;
    int64_t at_ns;     /* when it was taken, CLOCK_MONOTONIC */
    uint32_t sequence; /* frames so far, this one included */
};

struct frames {
    struct frame buffers[3];
    _Alignas(64) uint32_t writing; /* the producer's buffer */
    uint32_t written;              /* frames so far */
    _Alignas(64) uint32_t reading; /* the consumer's */
    _Alignas(64) _Atomic uint32_t between;
};

/* Buffers of `bytes` each, in memory of the block. FL_OK, or FL_FAILED after fl_fail(). */
int frames_allocate(struct fl_block *block, struct frames *frames, size_t bytes);

/* The producer's buffer, to be filled and then handed over by frames_publish. */
uint8_t *frames_back(struct frames *frames);
void frames_publish(struct frames *frames, int64_t at_ns);

/* The newest frame since the last call, NULL when there is none. It stays as it is until the next call. */
const struct frame *frames_newest(struct frames *frames);

#endif
