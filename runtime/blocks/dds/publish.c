/** dds-publish
 *
 * Publishes its input as a sample of a DDS topic, in each step or whenever `sequence` changes. The step puts the
 * sample into a ring; a thread gives it to DDS, which may allocate and block.
 *
 * Failure: No step waits for DDS. A sample that is older than `lifespan` when its turn comes is dropped, as is all but
 * the newest of those that wait. `written` counts what DDS took. While DDS cannot be had the thread tries again every
 * second, and writes to the journal. While `withhold` is 1 the block is silent, so that subscribers fail over.
 */
#define _GNU_SOURCE
#include "topic.h"

#include <errno.h>
#include <math.h>
#include <stdatomic.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { WAITING = 4 };

struct dds_publish {
    struct dds_settings common;
    int64_t robot;
    double lifespan;
};

struct state {
    struct dds_settings settings;
    struct fl_block *block;
    struct fl_driver *driver;
    struct fl_ring samples;
    struct dds_sample taken; /* the thread's */
    void *storage;
    int wake[2]; /* a byte for each sample: the step's end, and the thread's */
    uint32_t number;
    uint32_t sequence; /* sequence in the step before; 0: nothing has come yet, or the input has no wire */
    _Atomic uint32_t peers, written;
};

static const struct fl_parameter parameters[] = {
    DDS_PARAMETERS(struct dds_settings),
    FL_PARAMETER(struct dds_publish, robot, .min = 0, .max = 65535, .summary = "number of the robot that sends"),
    FL_PARAMETER(struct dds_publish, lifespan, .default_value = "0.1", .min = 0.001, .max = 3600, .unit = "s",
                 .summary = "older samples are not sent, nor sent again: they would look new to the subscriber"),
};

enum { WITHHOLD, SEQUENCE, DATA };
static const struct fl_port inputs[] = {
    {.name = "withhold", .type = FL_BOOLEAN, .width = 1, .flags = FL_OPTIONAL, .summary = "1: nothing is published"},
    {.name = "sequence",
     .type = FL_UINT32,
     .width = 1,
     .flags = FL_OPTIONAL,
     .summary = "sequence of the input that the data are made from: publish only when it has changed"},
};

enum { PEERS, WRITTEN };
static const struct fl_port outputs[] = {
    {.name = "peers", .type = FL_UINT32, .width = 1, .summary = "subscribers that are known now"},
    {.name = "written", .type = FL_UINT32, .width = 1, .summary = "samples that DDS took"},
};

static void matched(dds_entity_t writer, const dds_publication_matched_status_t status, void *context)
{
    struct state *state = context;
    (void)writer;
    atomic_store(&state->peers, status.current_count);
}

/* Write the newest waiting sample. Older ones are useless, as is one that waited too long for DDS, or in a stopped
 * process. */
static void write_newest(struct state *state, dds_entity_t writer)
{
    const struct dds_publish *set = state->block->parameters;
    char tokens[64];
    bool any = false;
    while (recv(state->wake[1], tokens, sizeof tokens, MSG_DONTWAIT) > 0)
        ;
    while (fl_ring_take(&state->samples, &state->taken))
        any = true;
    if (!any || fl_now_ns() - state->taken.made_ns > llround(set->lifespan * 1e9))
        return;
    dds_encode(&state->settings, &state->taken, state->storage);
    if (dds_write(writer, state->storage) == DDS_RETCODE_OK)
        atomic_fetch_add(&state->written, 1);
}

static void set_listener(dds_listener_t *listener)
{
    dds_lset_publication_matched(listener, matched);
}

/* A best-effort writer keeps no sample, and so no instance. DDS would create the instance for each sample, and its
 * garbage collector, at the same priority, remove it again. A registered instance stays until the participant is
 * deleted. */
static void keep_instance(struct state *state, dds_entity_t writer)
{
    const struct dds_publish *set = state->block->parameters;
    dds_instance_handle_t handle;
    state->taken.robot = (uint16_t)set->robot;
    dds_encode(&state->settings, &state->taken, state->storage);
    dds_return_t registered = dds_register_instance(writer, &handle, state->storage);
    if (registered != DDS_RETCODE_OK)
        fl_log(state->block, "topic %s: instance: %s", state->settings.topic, dds_strretcode(registered));
}

static void serve(void *context, struct fl_driver *driver, dds_entity_t writer)
{
    struct state *state = context;
    keep_instance(state, writer);
    while (fl_driver_wait(driver, state->wake[1], false, -1) == 1)
        write_newest(state, writer);
}

static void run(struct fl_driver *driver, void *context)
{
    static const struct dds_endpoint endpoint = {dds_create_writer, set_listener, serve};
    struct state *state = context;
    const struct dds_publish *set = state->block->parameters;
    dds_run(&endpoint, &state->settings, set->lifespan, state->block, driver, state);
}

static int configure(struct fl_block *block)
{
    return fl_add_input(block, dds_port(block->parameters));
}

static int start(struct fl_block *block)
{
    struct state *state = block->state;
    void *memory = fl_allocate(block, fl_ring_bytes(sizeof(struct dds_sample), WAITING));
    state->storage = fl_allocate(block, dds_storage_bytes());
    if (!memory || !state->storage)
        return FL_FAILED;
    state->settings = ((const struct dds_publish *)block->parameters)->common;
    state->block = block;
    fl_ring_initialize(&state->samples, memory, sizeof(struct dds_sample), WAITING);
    if (socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, state->wake) < 0)
        return fl_fail(block, "socketpair: %s", strerror(errno));
    state->driver = fl_driver_start(block, run, state);
    return state->driver ? FL_OK : FL_FAILED;
}

static int step(struct fl_block *block)
{
    const struct dds_publish *set = block->parameters;
    struct state *state = block->state;
    uint32_t before = state->sequence;
    state->sequence = FL_IN(block, SEQUENCE, uint32_t);
    if (!FL_IN(block, WITHHOLD, uint8_t) && !(before && before == state->sequence)) {
        struct dds_sample sample = {.robot = (uint16_t)set->robot, .number = state->number++};
        struct timespec real;
        clock_gettime(CLOCK_REALTIME, &real);
        sample.made_ns = fl_now_ns();
        sample.stamp_ns = real.tv_sec * INT64_C(1000000000) + real.tv_nsec;
        memcpy(sample.values, block->in[DATA], dds_value_bytes(&state->settings));
        if (fl_ring_put(&state->samples, &sample))
            send(state->wake[0], "", 1, MSG_DONTWAIT | MSG_NOSIGNAL);
    }
    FL_OUT(block, PEERS, uint32_t) = atomic_load(&state->peers);
    FL_OUT(block, WRITTEN, uint32_t) = atomic_load(&state->written);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    fl_driver_stop(state->driver);
    for (int i = 0; i < 2; i++)
        if (state->wake[i] > 0)
            close(state->wake[i]);
}

FL_BLOCK(dds_publish) = {
    .abi = FL_ABI,
    .name = "dds-publish",
    .summary = "publishes its input as a sample of a DDS topic, in each step",
    .source = "OMG DDS 1.4; DDSI-RTPS 2.5; Eclipse Cyclone DDS 0.10",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct dds_publish),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .terminate = terminate,
};
