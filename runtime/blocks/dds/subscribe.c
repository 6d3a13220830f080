/** dds-subscribe
 *
 * Gives the newest sample that a robot published on a DDS topic, or that a hot standby of it did. The block can
 * trigger a task.
 *
 * Failure: The flag is 0 once the newest sample is older than `timeout`, or than `deadline` where that is shorter.
 * While the flag is 0 the values stay the last good ones, and `age` grows. With several robots, one is listened to
 * once those before it have been silent for longer than `failover`. While DDS cannot be had the block tries again
 * every second, and writes to the journal.
 */
#define _GNU_SOURCE
#include "topic.h"

#include <errno.h>
#include <flotilla/failover.h>
#include <flotilla/sensor.h>
#include <math.h>
#include <stdatomic.h>
#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

enum { WAITING = 16, BATCH = 8 };

struct dds_subscribe {
    struct dds_settings common;
    struct fl_doubles robot;
    double failover, timeout;
};

struct state {
    struct dds_settings settings;
    struct fl_failover failover; /* DDS's thread's */
    struct fl_block *block;
    struct fl_driver *driver;
    struct fl_ring samples;
    struct dds_sample arriving, taken; /* DDS's thread's, the step's */
    int arrived_fd;                    /* readable after something was put into the ring */
    bool open, awaited;                /* awaited: await takes samples instead of the step */
    _Atomic uint32_t peers;
    struct fl_sensor sensor;
};

static const struct fl_parameter parameters[] = {
    DDS_PARAMETERS(struct dds_settings),
    FL_PARAMETER(struct dds_subscribe, robot, .min = 0, .max = 65535,
                 .summary = "number of the robot that sends, or several, the first in rank first"),
    FL_FAILOVER(struct dds_subscribe),
    FL_SENSOR_TIMEOUT(struct dds_subscribe, "0.1"),
};

enum { VALUES, NUMBER, STAMP, PEERS, SENDER, FLAG };

static void matched(dds_entity_t reader, const dds_subscription_matched_status_t status, void *context)
{
    struct state *state = context;
    (void)reader;
    atomic_store(&state->peers, status.current_count);
}

/* The rank of the robot that sent the sample, or the number of ranks if it is not listened to. */
static size_t rank_of(const struct fl_doubles *robots, const struct dds_sample *sample)
{
    size_t rank = 0;
    while (rank < robots->count && lround(robots->value[rank]) != sample->robot)
        rank++;
    return rank;
}

/* Called by DDS, one call at a time for a reader. A topic carries the samples of all robots: keep those of the right
 * one. */
static void arrived(dds_entity_t reader, void *context)
{
    struct state *state = context;
    const struct dds_subscribe *set = state->block->parameters;
    void *samples[BATCH] = {NULL};
    dds_sample_info_t infos[BATCH];
    dds_return_t count;
    int64_t now_ns = fl_now_ns();
    while ((count = dds_take(reader, samples, infos, BATCH, BATCH)) > 0) {
        for (dds_return_t i = 0; i < count; i++) {
            if (!infos[i].valid_data || !dds_decode(&state->settings, samples[i], &state->arriving))
                continue;
            size_t rank = rank_of(&set->robot, &state->arriving);
            if (rank == set->robot.count || !fl_failover_takes(&state->failover, rank, now_ns, set->failover))
                continue;
            state->arriving.sender = (uint32_t)rank;
            state->arriving.arrived_ns = now_ns;
            fl_ring_put(&state->samples, &state->arriving);
            eventfd_write(state->arrived_fd, 1);
        }
        dds_return_loan(reader, samples, count);
        samples[0] = NULL;
    }
}

static void set_listener(dds_listener_t *listener)
{
    dds_lset_data_available(listener, arrived);
    dds_lset_subscription_matched(listener, matched);
}

/* DDS's own thread calls the listener. */
static void serve(void *context, struct fl_driver *driver, dds_entity_t reader)
{
    (void)context;
    (void)reader;
    fl_driver_wait(driver, -1, false, -1);
}

static void run(struct fl_driver *driver, void *context)
{
    static const struct dds_endpoint endpoint = {dds_create_reader, set_listener, serve};
    struct state *state = context;
    dds_run(&endpoint, &state->settings, 0, state->block, driver, state);
}

static int configure(struct fl_block *block)
{
    const struct dds_subscribe *set = block->parameters;
    const struct fl_port outputs[] = {
        dds_port(&set->common),
        {.name = "number", .type = FL_UINT32, .width = 1, .summary = "the sender's count of its samples"},
        {.name = "stamp", .type = FL_INT64, .width = 1, .unit = "ns", .summary = "the sender's fleet time"},
        {.name = "peers", .type = FL_UINT32, .width = 1, .summary = "publishers of the topic that are known now"},
        {.name = "sender",
         .type = FL_UINT32,
         .width = 1,
         .summary = "rank of the sender that is listened to: 0 is the first of `robot`"},
        FL_SENSOR_OUTPUTS,
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
    struct state *state = block->state;
    void *memory = fl_allocate(block, fl_ring_bytes(sizeof(struct dds_sample), WAITING));
    if (!memory)
        return FL_FAILED;
    state->settings = ((const struct dds_subscribe *)block->parameters)->common;
    state->block = block;
    fl_sensor_begin(&state->sensor);
    fl_failover_begin(&state->failover, fl_now_ns());
    fl_ring_initialize(&state->samples, memory, sizeof(struct dds_sample), WAITING);
    state->arrived_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    if (state->arrived_fd < 0)
        return fl_fail(block, "eventfd: %s", strerror(errno));
    state->open = true;
    state->driver = fl_driver_start(block, run, state);
    return state->driver ? FL_OK : FL_FAILED;
}

/* Take the newest sample that waits. When it arrived; 0: none did. */
static int64_t take(struct fl_block *block)
{
    struct state *state = block->state;
    int64_t taken_ns = 0;
    for (int i = 0; i < WAITING && fl_ring_take(&state->samples, &state->taken); i++) {
        memcpy(block->out[VALUES], state->taken.values, dds_value_bytes(&state->settings));
        FL_OUT(block, NUMBER, uint32_t) = state->taken.number;
        FL_OUT(block, STAMP, int64_t) = state->taken.stamp_ns;
        FL_OUT(block, SENDER, uint32_t) = state->taken.sender;
        fl_sensor_update(&state->sensor, state->taken.arrived_ns, state->sensor.sequence + 1);
        taken_ns = state->taken.arrived_ns;
    }
    return taken_ns;
}

/* Take the sample here instead of in the step: the step could find a newer one than the sample that triggered it. */
static int64_t await(struct fl_block *block, int64_t until_ns)
{
    struct state *state = block->state;
    int64_t taken_ns;
    state->awaited = true;
    do {
        eventfd_t count;
        eventfd_read(state->arrived_fd, &count); /* before the look into the ring: what comes after it is not missed */
        taken_ns = take(block);
    } while (!taken_ns && fl_await_readable(state->arrived_fd, until_ns));
    return taken_ns ? taken_ns : take(block); /* a sample may have come while this thread woke up */
}

static int step(struct fl_block *block)
{
    const struct dds_subscribe *set = block->parameters;
    struct state *state = block->state;
    if (!state->awaited)
        take(block);
    FL_OUT(block, PEERS, uint32_t) = atomic_load(&state->peers);
    /* Go by the age of the sample: the status of DDS covers all robots that publish the topic. */
    const double deadline = set->common.deadline;
    fl_sensor_outputs(&state->sensor, block, FLAG, true, deadline > 0 ? fmin(deadline, set->timeout) : set->timeout);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    fl_driver_stop(state->driver);
    if (state->open)
        close(state->arrived_fd);
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
