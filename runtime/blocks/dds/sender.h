/* What blocks that publish share: the step hands a sample to a thread, which gives the newest one to DDS. */
#ifndef FLOTILLA_DDS_SENDER_H
#define FLOTILLA_DDS_SENDER_H

#include "core/newest.h"
#include "endpoint.h"

struct dds_sender {
    /* Set by the block before it starts the sender. */
    struct dds_topic topic;
    size_t sample_bytes;  /* of a sample, which begins with an int64_t: CLOCK_MONOTONIC when it was made */
    size_t storage_bytes; /* of the topic's C structure */
    /* Make that structure, for the thread. What it points to may lie in the sample. */
    void (*encode)(const struct fl_block *block, const void *sample, void *storage);

    /* The sender's own. */
    struct fl_block *block;
    struct fl_driver *driver;
    struct newest samples;
    void *first; /* the sample of dds_sender_start */
    void *storage;
    int wake[2];       /* a byte for each sample: the step's end, and the thread's */
    uint32_t sequence; /* sequence in the step before; 0: nothing has come yet, or the input has no wire */
    _Atomic uint32_t peers, written;
};

/* The first inputs and outputs of a block that publishes; its other inputs come after them. */
enum { DDS_WITHHOLD, DDS_SEQUENCE, DDS_DATA };
enum { DDS_PEERS, DDS_WRITTEN };
extern const struct fl_port dds_sender_inputs[DDS_DATA], dds_sender_outputs[DDS_WRITTEN + 1];

/* Allocate, and start the thread. `first` is a sample of the instance that is published. */
int dds_sender_start(struct dds_sender *sender, struct fl_block *block, const void *first);

/* The step: what to fill if there is something to publish in this one, otherwise NULL. Its time is set. */
void *dds_sender_begin(struct dds_sender *sender);

/* The end of the step: publish what was filled, and write the outputs. NULL: nothing was. */
void dds_sender_end(struct dds_sender *sender, const void *made);

void dds_sender_stop(struct dds_sender *sender);

#endif
