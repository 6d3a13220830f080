/** dds-publish
 *
 * Publishes its input as a sample of a DDS topic, in each step or whenever `sequence` changes. The step
 * hands the sample to a thread, which gives it to DDS, which may allocate and block.
 *
 * Failure: No step waits for DDS. A sample that is older than `lifespan` when its turn comes is dropped, as is all but
 * the newest of those that wait. `written` counts what DDS took. While DDS cannot be had the thread tries again every
 * second, and writes to the journal. While `withhold` is 1 the block is silent, so that subscribers fail over.
 */
#include "core/wall_clock.h"
#include "sender.h"
#include "topic.h"

#include <string.h>

struct dds_publish {
    struct dds_settings common;
    int64_t robot;
    double lifespan;
};

struct state {
    struct dds_sender sender;
    uint32_t number;
};

static const struct fl_parameter parameters[] = {
    DDS_PARAMETERS,
    FL_PARAMETER(struct dds_publish, robot, .min = 0, .max = 65535, .summary = "number of the robot that sends"),
    DDS_LIFESPAN(struct dds_publish),
};

static void encode(const struct fl_block *block, const void *sample, void *storage)
{
    dds_encode(block->parameters, sample, storage);
}

static int configure(struct fl_block *block)
{
    return fl_add_input(block, dds_port(block->parameters));
}

static int start(struct fl_block *block)
{
    const struct dds_publish *set = block->parameters;
    struct state *state = block->state;
    const struct dds_sample first = {.robot = (uint16_t)set->robot};
    state->sender.topic = dds_topic(&set->common);
    state->sender.topic.lifespan = set->lifespan;
    dds_enter_partition(&state->sender.topic, &set->common, (uint16_t)set->robot);
    state->sender.sample_bytes = sizeof first;
    state->sender.storage_bytes = dds_storage_bytes();
    state->sender.encode = encode;
    return dds_sender_start(&state->sender, block, &first);
}

static int step(struct fl_block *block)
{
    const struct dds_publish *set = block->parameters;
    struct state *state = block->state;
    struct dds_sample *sample = dds_sender_begin(&state->sender);
    if (sample) {
        sample->robot = (uint16_t)set->robot;
        sample->number = state->number++;
        sample->stamp_ns = fl_clock_ns(CLOCK_REALTIME);
        memcpy(sample->values, block->in[DDS_DATA], dds_value_bytes(&set->common));
    }
    dds_sender_end(&state->sender, sample);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    dds_sender_stop(&((struct state *)block->state)->sender);
}

FL_BLOCK(dds_publish) = {
    .abi = FL_ABI,
    .name = "dds-publish",
    .summary = "publishes its input as a sample of a DDS topic, in each step",
    .source = "OMG DDS 1.4; DDSI-RTPS 2.5; Eclipse Cyclone DDS 0.10",
    FL_TABLE(input, dds_sender_inputs),
    FL_TABLE(output, dds_sender_outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct dds_publish),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .terminate = terminate,
};
