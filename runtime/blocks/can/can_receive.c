/** can-receive
 *
 * Receives the newest data frame of an identifier, or of several by `mask`, on a CAN bus. Frames are stamped by the
 * kernel. A step takes all that wait, which are about 300.
 *
 * Failure: The flag is 0 once no frame came for `timeout`, and while the interface is missing or down, or the
 * controller has left the bus. While the flag is 0 the values stay the last good ones, and `age` grows. The block
 * waits for its interface as long as it runs; the journal says once what is wrong.
 */
#include "socket.h"

#include <flotilla/sensor.h>
#include <string.h>

struct can_receive {
    const char *interface;
    int64_t id, mask;
    bool extended;
    double timeout;
};

struct received {
    struct can_socket can;
    struct fl_sensor sensor;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct can_receive, interface, .flags = FL_CAN_INTERFACE, .default_value = "can0",
                 .summary = "network interface of the bus"),
    FL_PARAMETER(struct can_receive, id, .min = 0, .max = CAN_EFF_MASK, .summary = "identifier to receive"),
    FL_PARAMETER(struct can_receive, mask, .default_value = "0x1FFFFFFF", .min = 0, .max = CAN_EFF_MASK,
                 .summary = "bits of the identifier that must be as in `id`"),
    FL_PARAMETER(struct can_receive, extended, .default_value = "false",
                 .summary = "identifiers of 29 bits instead of 11"),
    FL_SENSOR_TIMEOUT(struct can_receive, "1"),
};

enum { DATA, LENGTH, IDENTIFIER, FLAG };
static const struct fl_port outputs[] = {
    {.name = "data",
     .type = FL_UINT8,
     .width = CAN_MAX_DLEN,
     .summary = "bytes of the newest frame, zero beyond `length`"},
    {.name = "length", .type = FL_UINT8, .width = 1, .unit = "B", .summary = "how many bytes it had"},
    {.name = "id", .type = FL_UINT32, .width = 1, .summary = "its identifier"},
    FL_SENSOR_OUTPUTS,
};

static int configure(struct fl_block *block)
{
    const struct can_receive *set = block->parameters;
    if (!set->extended && set->id > CAN_SFF_MASK)
        return fl_fail(block, "id 0x%X has more than 11 bits: set `extended`", (unsigned)set->id);
    return FL_OK;
}

static int start(struct fl_block *block)
{
    const struct can_receive *set = block->parameters;
    struct received *received = block->state;
    /* Data frames of the one format only: neither the other format's nor remote requests. */
    const struct can_filter filter = {
        .can_id = (canid_t)set->id | (set->extended ? CAN_EFF_FLAG : 0),
        .can_mask = ((canid_t)set->mask & (set->extended ? CAN_EFF_MASK : CAN_SFF_MASK)) | CAN_EFF_FLAG | CAN_RTR_FLAG,
    };
    fl_sensor_begin(&received->sensor);
    return can_start(block, &received->can, set->interface, &filter, 1);
}

static int step(struct fl_block *block)
{
    const struct can_receive *set = block->parameters;
    struct received *received = block->state;
    struct can_frame frame;
    int64_t arrived_ns;
    for (int i = 0; i < SOCKET_BURST && can_receive(&received->can, &frame, &arrived_ns); i++) {
        memset(block->out[DATA], 0, CAN_MAX_DLEN);
        memcpy(block->out[DATA], frame.data, frame.len);
        FL_OUT(block, LENGTH, uint8_t) = frame.len;
        FL_OUT(block, IDENTIFIER, uint32_t) = frame.can_id & CAN_EFF_MASK;
        fl_sensor_update(&received->sensor, arrived_ns, received->sensor.sequence + 1);
    }
    bool there = can_connected(&received->can) && !atomic_load(&received->can.bus_off);
    fl_sensor_outputs(&received->sensor, block, FLAG, there, set->timeout);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct received *received = block->state;
    can_stop(&received->can);
}

FL_BLOCK(can_receive) = {
    .abi = FL_ABI,
    .name = "can-receive",
    .summary = "the newest frame of an identifier on a CAN bus",
    .source = "ISO 11898-1; Linux, Documentation/networking/can.rst",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct can_receive),
    .state_size = sizeof(struct received),
    .configure = configure,
    .start = start,
    .step = step,
    .terminate = terminate,
};
