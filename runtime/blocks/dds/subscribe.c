/** dds-subscribe
 *
 * Gives the newest sample that a robot published on a DDS topic, or that a hot standby of it did. The block can
 * trigger a task.
 *
 * Failure: The flag is 0 once the newest sample is older than `timeout`, or than `deadline` where that is shorter.
 * While the flag is 0 the values stay the last good ones, and `age` grows. With several robots, one is listened to
 * once those before it have been silent for longer than `failover`. While DDS cannot be had the block tries again
 * every second, and writes to the journal. With `partition: robot` a sample that comes through another robot's
 * partition than the one it names is not taken, and is counted in `forged`.
 */
#include "receiver.h"
#include "topic.h"

#include <flotilla/failover.h>
#include <math.h>
#include <string.h>

struct dds_subscribe {
    struct dds_settings common;
    struct fl_doubles robot;
    double failover, timeout;
};

enum { WRITERS = 8 };

struct state {
    struct dds_receiver receiver;
    _Atomic uint32_t forged;
    /* DDS's thread's. */
    struct fl_failover failover;
    struct {
        dds_instance_handle_t handle;
        int robot;
    } writers[WRITERS]; /* those that sent last */
    unsigned next;
};

static const struct fl_parameter parameters[] = {
    DDS_PARAMETERS,
    FL_PARAMETER(struct dds_subscribe, robot, .min = 0, .max = 65535,
                 .summary = "number of the robot that sends, or several, the first in rank first"),
    FL_FAILOVER(struct dds_subscribe),
    FL_SENSOR_TIMEOUT(struct dds_subscribe, "0.1"),
};

enum { VALUES, NUMBER, STAMP, PEERS, SENDER, FLAG, AGE, SEQUENCE, FORGED };

/* The rank of the robot that sent the sample, or the number of ranks if it is not listened to. */
static size_t rank_of(const struct fl_doubles *robots, const struct dds_sample *sample)
{
    size_t rank = 0;
    while (rank < robots->count && lround(robots->value[rank]) != sample->robot)
        rank++;
    return rank;
}

/* The robot that the sample is from by the partition of its writer, which stays the same for as long as there is the
 * writer. */
static int robot_of_writer(struct state *state)
{
    const struct dds_receiver *receiver = &state->receiver;
    for (int i = 0; i < WRITERS; i++)
        if (state->writers[i].handle == receiver->writer)
            return state->writers[i].robot;
    int robot = dds_robot_of_partition(receiver->reader, receiver->writer);
    state->writers[state->next].handle = receiver->writer;
    state->writers[state->next].robot = robot;
    state->next = (state->next + 1) % WRITERS;
    return robot;
}

/* A topic carries the samples of all robots: keep those of the right one. */
static bool decode(struct fl_block *block, const void *storage, void *arriving)
{
    const struct dds_subscribe *set = block->parameters;
    struct state *state = block->state;
    struct dds_sample *sample = arriving;
    if (!dds_decode(&set->common, storage, sample))
        return false;
    if (set->common.partition == DDS_ROBOTS_PARTITION && robot_of_writer(state) != sample->robot) {
        atomic_fetch_add(&state->forged, 1);
        return false;
    }
    size_t rank = rank_of(&set->robot, sample);
    sample->sender = (uint32_t)rank;
    return rank < set->robot.count && fl_failover_takes(&state->failover, rank, sample->time_ns, set->failover);
}

static void give(struct fl_block *block, const void *taken)
{
    const struct dds_sample *sample = taken;
    memcpy(block->out[VALUES], sample->values, dds_value_bytes(block->parameters));
    FL_OUT(block, NUMBER, uint32_t) = sample->number;
    FL_OUT(block, STAMP, int64_t) = sample->stamp_ns;
    FL_OUT(block, SENDER, uint32_t) = sample->sender;
}

static int configure(struct fl_block *block)
{
    const struct dds_subscribe *set = block->parameters;
    const struct fl_port outputs[] = {
        dds_port(&set->common),
        {.name = "number", .type = FL_UINT32, .width = 1, .summary = "the sender's count of its samples"},
        {.name = "stamp", .type = FL_INT64, .width = 1, .unit = "ns", .summary = "the sender's fleet time"},
        DDS_RECEIVER_PEERS,
        {.name = "sender",
         .type = FL_UINT32,
         .width = 1,
         .summary = "rank of the sender that is listened to: 0 is the first of `robot`"},
        FL_SENSOR_OUTPUTS,
        {.name = "forged",
         .type = FL_UINT32,
         .width = 1,
         .flags = FL_REFUSALS,
         .summary = "samples that name another robot than the one whose partition they came through"},
    };
    if (set->robot.count < 1 || set->robot.count > FL_SENDERS)
        return fl_fail(block, "parameter robot: give 1 to %d numbers", FL_SENDERS);
    for (size_t i = 0; i < set->robot.count; i++)
        if (set->robot.value[i] != floor(set->robot.value[i]))
            return fl_fail(block, "parameter robot: %g is not a whole number", set->robot.value[i]);
    for (size_t i = 0; i < sizeof outputs / sizeof outputs[0]; i++)
        if (fl_add_output(block, outputs[i]) != FL_OK)
            return FL_FAILED;
    return FL_OK;
}

static int start(struct fl_block *block)
{
    const struct dds_subscribe *set = block->parameters;
    struct state *state = block->state;
    state->receiver.topic = dds_topic(&set->common);
    for (size_t i = 0; i < set->robot.count; i++)
        dds_enter_partition(&state->receiver.topic, &set->common, (uint16_t)lround(set->robot.value[i]));
    state->receiver.sample_bytes = sizeof(struct dds_sample);
    state->receiver.decode = decode;
    state->receiver.give = give;
    fl_failover_begin(&state->failover, fl_now_ns());
    return dds_receiver_start(&state->receiver, block);
}

static int64_t await(struct fl_block *block, int64_t until_ns)
{
    return dds_receiver_await(&((struct state *)block->state)->receiver, until_ns);
}

static int step(struct fl_block *block)
{
    const struct dds_subscribe *set = block->parameters;
    struct state *state = block->state;
    dds_receiver_step(&state->receiver, PEERS, FLAG, set->timeout);
    FL_OUT(block, FORGED, uint32_t) = atomic_load(&state->forged);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    dds_receiver_stop(&((struct state *)block->state)->receiver);
}

FL_BLOCK(dds_subscribe) = {
    .abi = FL_ABI,
    .name = "dds-subscribe",
    .summary = "the newest sample that a robot, or its hot standby, published on a DDS topic",
    .source = "OMG DDS 1.4; DDSI-RTPS 2.5; Eclipse Cyclone DDS 0.10",
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct dds_subscribe),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .await = await,
    .terminate = terminate,
};
