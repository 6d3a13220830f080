/** can-send
 *
 * Sends a data frame on a CAN bus in each step.
 *
 * Failure: While `age` is beyond `timeout` the frame carries `reset` instead of the data; without `reset` nothing is
 * sent. The `reset` frame is also sent when the task ends, in whatever way, as long as the process can act. The flag
 * is 0 while the queue is full, the interface is missing or down, or the controller has left the bus; a frame that was
 * refused is not kept. The block waits for its interface as long as it runs.
 */
#include "socket.h"

#include <ctype.h>
#include <string.h>

struct can_send {
    const char *interface;
    int64_t id, length;
    bool extended;
    const char *reset;
    double timeout;
};

struct sent {
    struct can_socket can;
    struct can_frame frame, reset;
    bool resets;
    uint32_t count;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct can_send, interface, .flags = FL_EXCLUSIVE | FL_CAN_INTERFACE, .default_value = "can0",
                 .summary = "network interface of the bus"),
    FL_PARAMETER(struct can_send, id, .flags = FL_EXCLUSIVE, .min = 0, .max = CAN_EFF_MASK,
                 .summary = "identifier of the frames"),
    FL_PARAMETER(struct can_send, length, .default_value = "8", .min = 0, .max = CAN_MAX_DLEN, .unit = "B",
                 .summary = "bytes of a frame"),
    FL_PARAMETER(struct can_send, extended, .flags = FL_EXCLUSIVE, .default_value = "false",
                 .summary = "an identifier of 29 bits instead of 11"),
    FL_PARAMETER(struct can_send, reset, .default_value = "",
                 .summary = "data of the frame sent instead when the data are too old, and at the end, as hexadecimal "
                            "digits; empty: none is sent"),
    FL_PARAMETER(struct can_send, timeout, .flags = FL_ACTUATOR_TIMEOUT, .default_value = "0.5", .min = 1e-6,
                 .max = 1e6, .unit = "s", .summary = "age from which the data are too old"),
};

enum { DATA, AGE };
enum { FLAG, SENT };
static const struct fl_port outputs[] = {
    {.name = "flag",
     .type = FL_BOOLEAN,
     .width = 1,
     .summary = "1: the controller took the last frame, and is on the bus"},
    {.name = "sent", .type = FL_UINT32, .width = 1, .summary = "frames that it took"},
};

static int digit(char c)
{
    return isdigit((unsigned char)c) ? c - '0' : isxdigit((unsigned char)c) ? tolower((unsigned char)c) - 'a' + 10 : -1;
}

/* The bytes that `text` writes in hexadecimal; their number, or -1. */
static int bytes_of(const char *text, uint8_t *bytes, int limit)
{
    int count = 0;
    for (; *text; text += 2, count++) {
        int high = digit(text[0]), low = high < 0 ? -1 : digit(text[1]);
        if (low < 0 || count == limit)
            return -1;
        bytes[count] = (uint8_t)(high << 4 | low);
    }
    return count;
}

static int configure(struct fl_block *block)
{
    const struct can_send *set = block->parameters;
    uint8_t bytes[CAN_MAX_DLEN];
    int reset = bytes_of(set->reset, bytes, CAN_MAX_DLEN);
    if (!set->extended && set->id > CAN_SFF_MASK)
        return fl_fail(block, "id 0x%X has more than 11 bits: set `extended`", (unsigned)set->id);
    if (*set->reset && reset != set->length)
        return fl_fail(block, "reset %s is not %d bytes in hexadecimal", set->reset, (int)set->length);
    if (fl_add_input(block, (struct fl_port){.name = "data",
                                             .type = FL_UINT8,
                                             .width = set->length ? (uint32_t)set->length : 1,
                                             .flags = set->length ? 0 : FL_OPTIONAL,
                                             .summary = "bytes of the frame"}) != FL_OK)
        return FL_FAILED;
    return fl_add_input(block, (struct fl_port){.name = "age",
                                                .type = FL_DOUBLE,
                                                .width = 1,
                                                .unit = "s",
                                                .summary = "age of the data: the output `age` of their "
                                                           "source, or 0 where they are constant"});
}

static int start(struct fl_block *block)
{
    const struct can_send *set = block->parameters;
    struct sent *sent = block->state;
    sent->frame.can_id = (canid_t)set->id | (set->extended ? CAN_EFF_FLAG : 0);
    sent->frame.len = (uint8_t)set->length;
    sent->reset = sent->frame;
    sent->resets = bytes_of(set->reset, sent->reset.data, CAN_MAX_DLEN) > 0;
    return can_start(block, &sent->can, set->interface, NULL, 0); /* no filter: nothing but reports is received */
}

static int step(struct fl_block *block)
{
    const struct can_send *set = block->parameters;
    struct sent *sent = block->state;
    struct can_frame none;
    int64_t arrived_ns;
    can_receive(&sent->can, &none, &arrived_ns);
    bool fresh = FL_IN(block, AGE, double) <= set->timeout;
    memcpy(sent->frame.data, block->in[DATA], sent->frame.len);
    bool off = fresh && memcmp(sent->frame.data, sent->reset.data, sent->frame.len) == 0;
    fresh &= !sent->resets || fl_may_act(block, off);
    bool taken = (fresh || sent->resets) && can_send(&sent->can, fresh ? &sent->frame : &sent->reset);
    sent->count += taken;
    FL_OUT(block, FLAG, bool) = taken && can_connected(&sent->can) && !atomic_load(&sent->can.bus_off);
    FL_OUT(block, SENT, uint32_t) = sent->count;
    return FL_OK;
}

static void safe(struct fl_block *block)
{
    struct sent *sent = block->state;
    if (sent->resets && (!can_send(&sent->can, &sent->reset) || atomic_load(&sent->can.bus_off)))
        fl_not_safe(block, "its reset frame could not be sent");
}

static void terminate(struct fl_block *block)
{
    struct sent *sent = block->state;
    safe(block);
    can_stop(&sent->can);
}

FL_BLOCK(can_send) = {
    .abi = FL_ABI,
    .name = "can-send",
    .summary = "sends a frame on a CAN bus in each step",
    .source = "ISO 11898-1; Linux, Documentation/networking/can.rst",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct can_send),
    .state_size = sizeof(struct sent),
    .configure = configure,
    .start = start,
    .step = step,
    .safe = safe,
    .terminate = terminate,
};
