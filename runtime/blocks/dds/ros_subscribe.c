/** ros-subscribe
 *
 * Gives the newest message of a topic of ROS 2, whoever published it by whichever of ROS's DDS middlewares. The block
 * can trigger a task. Strings have no outputs: `frame_id` says which frame is wanted.
 *
 * Failure: The flag is 0 once the newest message is older than `timeout`, or than `deadline` where that is shorter.
 * While the flag is 0 the values stay the last good ones, and `age` grows. A message of another frame, or one whose
 * sequences are shorter than `lengths`, is left out, and counted in `refused`. DDS drops a message with a string of
 * more than 255 characters or a sequence of more than 10000 elements. While DDS cannot be had the block tries again
 * every second, and writes to the journal.
 */
#include "message.h"
#include "receiver.h"

#include <string.h>

struct ros_subscribe {
    struct message_settings common;
    const char *frame_id;
    double timeout;
};

struct state {
    struct dds_receiver receiver;
    struct message_layout layout;
    _Atomic uint32_t refused;
};

static const struct fl_parameter parameters[] = {
    MESSAGE_PARAMETERS("best-effort"),
    FL_PARAMETER(struct ros_subscribe, frame_id, .default_value = "",
                 .summary = "take messages of this frame only; without it, of any"),
    FL_SENSOR_TIMEOUT(struct ros_subscribe, "0.1"),
};

enum { STAMP, PEERS, REFUSED, FLAG, AGE, SEQUENCE, VALUES };
static const struct fl_port outputs[] = {
    {.name = "stamp",
     .type = FL_INT64,
     .width = 1,
     .unit = "ns",
     .summary = "in the header, since 1970-01-01 UTC; 0 for a type without header"},
    DDS_RECEIVER_PEERS,
    {.name = "refused", .type = FL_UINT32, .width = 1, .summary = "messages that were left out"},
    FL_SENSOR_OUTPUTS,
};

static bool decode(struct fl_block *block, const void *storage, void *arriving)
{
    const struct ros_subscribe *set = block->parameters;
    struct state *state = block->state;
    bool wanted = !*set->frame_id || strcmp(message_frame(storage), set->frame_id) == 0;
    bool taken = wanted && message_decode(&state->layout, storage, arriving);
    if (!taken)
        atomic_fetch_add(&state->refused, 1);
    return taken;
}

static void give(struct fl_block *block, const void *taken)
{
    const struct state *state = block->state;
    const struct message *message = taken;
    FL_OUT(block, STAMP, int64_t) = message->stamp_ns;
    for (uint32_t i = 0; i < state->layout.count; i++)
        memcpy(block->out[VALUES + i], message->values + state->layout.ports[i].offset,
               fl_type_size(state->layout.ports[i].field->type) * state->layout.ports[i].width);
}

static int configure(struct fl_block *block)
{
    const struct ros_subscribe *set = block->parameters;
    struct message_layout layout;
    if (message_lay_out(block, &set->common, &layout) != FL_OK)
        return FL_FAILED;
    if (*set->frame_id && !layout.type->header)
        return fl_fail(block, "parameter frame_id: the type has none: remove it");
    return message_add_ports(block, &layout, 0, fl_add_output);
}

static int start(struct fl_block *block)
{
    const struct ros_subscribe *set = block->parameters;
    struct state *state = block->state;
    if (message_lay_out(block, &set->common, &state->layout) != FL_OK)
        return FL_FAILED;
    state->receiver.topic = message_topic(&state->layout, &set->common);
    state->receiver.sample_bytes = state->layout.bytes;
    state->receiver.decode = decode;
    state->receiver.give = give;
    return dds_receiver_start(&state->receiver, block);
}

static int64_t await(struct fl_block *block, int64_t until_ns)
{
    return dds_receiver_await(&((struct state *)block->state)->receiver, until_ns);
}

static int step(struct fl_block *block)
{
    const struct ros_subscribe *set = block->parameters;
    struct state *state = block->state;
    dds_receiver_step(&state->receiver, PEERS, FLAG, set->timeout);
    FL_OUT(block, REFUSED, uint32_t) = atomic_load(&state->refused);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    dds_receiver_stop(&((struct state *)block->state)->receiver);
}

FL_BLOCK(ros_subscribe) = {
    .abi = FL_ABI,
    .name = "ros-subscribe",
    .summary = "the newest message of a topic of ROS 2",
    .source = "ROS 2 common_interfaces; design.ros2.org, Topic and Service name mapping to DDS; REP 103, REP 2011",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct ros_subscribe),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .await = await,
    .terminate = terminate,
};
