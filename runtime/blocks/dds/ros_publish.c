/** ros-publish
 *
 * Publishes its inputs as a message on a topic of ROS 2, in each step or whenever `sequence` changes. ROS 2 reads it
 * by any of its DDS middlewares, without a bridge. Frames and other strings are parameters; what is constant, such as
 * a covariance, can stand in the task file instead of a wire. The stamp is the wall clock less `age`.
 *
 * Without a wire an optional input is what ROS defines for an unknown value: NaN for a battery, -1 first in the
 * covariance for an IMU; otherwise zero.
 *
 * Failure: As for dds-publish: no step waits for DDS; a message that is older than `lifespan` when its turn comes is
 * dropped, as is all but the newest of those that wait. `written` counts what DDS took. While DDS cannot be had the
 * thread tries again every second, and writes to the journal. While `withhold` is 1 the block is silent.
 */
#include "core/wall_clock.h"
#include "message.h"
#include "sender.h"

#include <math.h>
#include <string.h>

struct ros_publish {
    struct message_settings common;
    const char *frame_id, *child_frame_id, *location, *serial_number;
    double lifespan;
};

struct state {
    struct dds_sender sender;
    struct message_layout layout;
    uint32_t absent; /* ports without a wire */
    uint32_t first;  /* input of the message's first port */
};

static const struct fl_parameter parameters[] = {
    MESSAGE_PARAMETERS("reliable"),
    DDS_LIFESPAN(struct ros_publish),
    FL_PARAMETER(struct ros_publish, frame_id, .default_value = "", .summary = "frame of the message, in its header"),
    FL_PARAMETER(struct ros_publish, child_frame_id, .default_value = "",
                 .summary = "frame whose pose an Odometry tells"),
    FL_PARAMETER(struct ros_publish, location, .default_value = "",
                 .summary = "where the battery of a BatteryState is"),
    FL_PARAMETER(struct ros_publish, serial_number, .default_value = "", .summary = "of the battery of a BatteryState"),
};

static const struct fl_port age = {.name = "age",
                                   .type = FL_DOUBLE,
                                   .width = 1,
                                   .flags = FL_OPTIONAL,
                                   .unit = "s",
                                   .summary = "of the measurement, such as a sensor's: the stamp is so long ago"};

/* A string that is given must fit, and must be one of the type's. */
static int judge(struct fl_block *block, const char *name, const char *string, bool there)
{
    if (*string && !there)
        return fl_fail(block, "parameter %s: the type has none: remove it", name);
    if (!message_string_fits(string))
        return fl_fail(block, "parameter %s: is too long: give at most 255 bytes", name);
    return FL_OK;
}

static int configure(struct fl_block *block)
{
    const struct ros_publish *set = block->parameters;
    struct message_layout layout;
    if (message_lay_out(block, &set->common, &layout) != FL_OK)
        return FL_FAILED;
    const struct message_type *type = layout.type;
    int failed = judge(block, "frame_id", set->frame_id, type->header) ||
                 judge(block, "child_frame_id", set->child_frame_id, type->strings.child_frame_id) ||
                 judge(block, "location", set->location, type->strings.location) ||
                 judge(block, "serial_number", set->serial_number, type->strings.serial_number) ||
                 (type->header && fl_add_input(block, age));
    return failed ? FL_FAILED : message_add_ports(block, &layout, FL_OPTIONAL, fl_add_input);
}

static void encode(const struct fl_block *block, const void *sample, void *storage)
{
    const struct ros_publish *set = block->parameters;
    const struct state *state = block->state;
    const struct message_type *type = state->layout.type;
    if (type->header)
        message_set_string(storage, MESSAGE_FRAME, set->frame_id);
    if (type->strings.child_frame_id)
        message_set_string(storage, type->strings.child_frame_id, set->child_frame_id);
    if (type->strings.location)
        message_set_string(storage, type->strings.location, set->location);
    if (type->strings.serial_number)
        message_set_string(storage, type->strings.serial_number, set->serial_number);
    message_encode(&state->layout, sample, state->absent, storage);
}

static int start(struct fl_block *block)
{
    const struct ros_publish *set = block->parameters;
    struct state *state = block->state;
    if (message_lay_out(block, &set->common, &state->layout) != FL_OK)
        return FL_FAILED;
    state->first = DDS_DATA + state->layout.type->header;
    for (uint32_t i = 0; i < state->layout.count; i++)
        if ((block->in_ports[state->first + i].flags & FL_OPTIONAL) && !fl_wired(block, state->first + i))
            state->absent |= 1u << i;
    state->sender.topic = message_topic(&state->layout, &set->common);
    state->sender.topic.lifespan = set->lifespan;
    state->sender.sample_bytes = state->layout.bytes;
    state->sender.storage_bytes = message_storage_bytes();
    state->sender.encode = encode;
    const void *first = fl_allocate(block, state->layout.bytes);
    return first ? dds_sender_start(&state->sender, block, first) : FL_FAILED;
}

/* When the measurement was made. */
static int64_t stamp_of(const struct fl_block *block)
{
    const double longest_s = 1e6;
    double age_s = fmin(fmax(0, FL_IN(block, DDS_DATA, double)), longest_s); /* 0 for NaN */
    int64_t stamp_ns = fl_clock_ns(CLOCK_REALTIME) - llround(age_s * 1e9);
    return stamp_ns > 0 ? stamp_ns : 0;
}

static int step(struct fl_block *block)
{
    struct state *state = block->state;
    const struct message_layout *layout = &state->layout;
    struct message *message = dds_sender_begin(&state->sender);
    if (message) {
        message->stamp_ns = layout->type->header ? stamp_of(block) : 0;
        for (uint32_t i = 0; i < layout->count; i++)
            memcpy(message->values + layout->ports[i].offset, block->in[state->first + i],
                   fl_type_size(layout->ports[i].field->type) * layout->ports[i].width);
    }
    dds_sender_end(&state->sender, message);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    dds_sender_stop(&((struct state *)block->state)->sender);
}

FL_BLOCK(ros_publish) = {
    .abi = FL_ABI,
    .name = "ros-publish",
    .summary = "publishes its inputs as a message on a topic of ROS 2",
    .source = "ROS 2 common_interfaces; design.ros2.org, Topic and Service name mapping to DDS; REP 103, REP 2011",
    FL_TABLE(input, dds_sender_inputs),
    FL_TABLE(output, dds_sender_outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct ros_publish),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .terminate = terminate,
};
