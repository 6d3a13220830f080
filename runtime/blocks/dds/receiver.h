/* What blocks that subscribe share: DDS's thread hands the newest sample to the step. */
#ifndef FLOTILLA_DDS_RECEIVER_H
#define FLOTILLA_DDS_RECEIVER_H

#include "core/newest.h"
#include "endpoint.h"

#include <flotilla/sensor.h>
#include <stdatomic.h>

struct dds_receiver {
    /* Set by the block before it starts the receiver. */
    struct dds_topic topic;
    size_t sample_bytes; /* of a sample, which begins with an int64_t: CLOCK_MONOTONIC when it arrived */
    /* Take what the step needs from the topic's C structure, for DDS's thread. False: not for this block. */
    bool (*decode)(struct fl_block *block, const void *storage, void *sample);
    /* Write a sample to the outputs, for the step. */
    void (*give)(struct fl_block *block, const void *sample);

    /* The receiver's own. */
    struct fl_block *block;
    struct fl_driver *driver;
    struct newest samples;
    uint32_t arrived;    /* samples so far; DDS's thread's */
    dds_entity_t reader; /* both of the sample that is decoded */
    dds_instance_handle_t writer;
    int arrived_fd;     /* readable after a sample was handed over */
    bool open, awaited; /* awaited: await takes samples instead of the step */
    _Atomic uint32_t peers;
    struct fl_sensor sensor;
};

#define DDS_RECEIVER_PEERS                                                                                             \
    {.name = "peers", .type = FL_UINT32, .width = 1, .summary = "publishers of the topic that are known now"}

/* Allocate, and start the thread. */
int dds_receiver_start(struct dds_receiver *receiver, struct fl_block *block);

/* The step: take the newest sample, and write the outputs `peers`, and flag, age and sequence from `flag` on. */
void dds_receiver_step(struct dds_receiver *receiver, uint32_t peers, uint32_t flag, double timeout);

/* The block's `await`. */
int64_t dds_receiver_await(struct dds_receiver *receiver, int64_t until_ns);

void dds_receiver_stop(struct dds_receiver *receiver);

#endif
