/** udp-receive
 *
 * Receives datagrams of one length. A step takes all that wait, at most 512, and looks at those that are refused for
 * about a quarter of a period. They are stamped by the kernel when they arrive. The block can trigger a task.
 *
 * Failure: The flag is 0 once no datagram was taken for `timeout`. While the flag is 0 the values stay the last good
 * ones, and `age` grows. Datagrams of another length or sender are counted in `refused`, those lost to a full queue in
 * `dropped`: between two steps about 100 long datagrams or 300 short ones find room, and `age` is that of the last.
 * With several senders, one is listened to once those before it have been silent for longer than `failover`. The
 * interface and the local address may come later, go, and come back.
 *
 * With `keys` each message carries 40 bytes more, which prove that it is the sender's and new. A message without that
 * is not taken; it is counted in `forged`, or in `replayed` if it came before. The first message after a start of
 * either side is such a one, too: the sender is asked, with 40 bytes, to prove that its messages are new.
 */
#include "core/udp.h"

#include <flotilla/driver.h>
#include <flotilla/sensor.h>
#include <string.h>

struct udp_receive {
    UDP_RECEIVER_MEMBERS;
    UDP_KEYS_MEMBER;
    int64_t length;
    int take;
    double timeout;
};

enum take { NEWEST, IN_ORDER };

static const struct fl_parameter parameters[] = {
    UDP_RECEIVER_PARAMETERS(struct udp_receive),
    UDP_KEYS_PARAMETER(struct udp_receive),
    FL_PARAMETER(struct udp_receive, length, .min = 1, .max = UDP_LONGEST, .unit = "B",
                 .summary = "payload of a datagram; one of another length is refused"),
    FL_PARAMETER(struct udp_receive, take, .default_value = "newest", .choices = "newest|in-order",
                 .summary = "each step takes the newest datagram, or the next one that waits"),
    FL_SENSOR_TIMEOUT(struct udp_receive, "0.1"),
};

static const struct fl_port outputs[] = {
    FL_SENSOR_OUTPUTS,
    UDP_RECEIVER_OUTPUTS,
    UDP_KEYS_OUTPUTS,
};

enum { FLAG, AGE, SEQUENCE, DROPPED, REFUSED, SENDER, FORGED, REPLAYED, DATA };

struct state {
    struct udp_receiver receiver;
    struct fl_sensor sensor;
    uint8_t *scratch;
    bool awaited; /* await takes, not the step */
};

static int configure(struct fl_block *block)
{
    const struct udp_receive *udp = block->parameters;
    if (udp_receiver_check(block, udp->local_address, udp->from) != FL_OK ||
        udp_check_keys(block, "from", udp->keys, udp->length, udp->from) != FL_OK)
        return FL_FAILED;
    return fl_add_output(block, (struct fl_port){.name = "data",
                                                 .type = FL_UINT8,
                                                 .width = (uint32_t)udp->length,
                                                 .summary = "payload of the last datagram taken"});
}

static int start(struct fl_block *block)
{
    const struct udp_receive *udp = block->parameters;
    struct state *state = block->state;
    fl_sensor_begin(&state->sensor);
    state->scratch = fl_allocate(block, (size_t)udp->length);
    if (!state->scratch)
        return FL_FAILED;
    return udp_receiver_open(&state->receiver, block, udp->local_address, udp->port, udp->interface, udp->from,
                             udp->failover, (size_t)udp->length, udp->keys);
}

/* Take the newest datagram that waits, or the next one. When it arrived; 0: none did. */
static int64_t take(struct fl_block *block)
{
    const struct udp_receive *udp = block->parameters;
    struct state *state = block->state;
    int64_t arrived_ns, taken_ns = 0;
    struct udp_budget budget = udp_budget_of(block);
    while (udp_receive(&state->receiver, state->scratch, &arrived_ns, &budget)) {
        memcpy(block->out[DATA], state->scratch, (size_t)udp->length);
        fl_sensor_update(&state->sensor, arrived_ns, state->sensor.sequence + 1);
        taken_ns = arrived_ns;
        if (udp->take == IN_ORDER)
            break;
    }
    return taken_ns;
}

/* Take the datagram here instead of in the step: the step could find a newer one than the datagram that triggered it.
 * Datagrams that are not accepted do not trigger a step. */
static int64_t await(struct fl_block *block, int64_t until_ns)
{
    struct state *state = block->state;
    int64_t taken_ns;
    state->awaited = true;
    while (!(taken_ns = take(block)) && fl_await_readable(state->receiver.sockets.fd[0], until_ns))
        continue;
    return taken_ns ? taken_ns : take(block); /* a datagram may have come while this thread woke up */
}

static int step(struct fl_block *block)
{
    const struct udp_receive *udp = block->parameters;
    struct state *state = block->state;
    if (!state->awaited)
        take(block);
    fl_sensor_outputs(&state->sensor, block, FLAG, true, udp->timeout);
    udp_receiver_outputs(&state->receiver, block, DROPPED);
    udp_keys_outputs(&state->receiver, block, FORGED);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    udp_receiver_close(&state->receiver);
}

FL_BLOCK(udp_receive) = {
    .abi = FL_ABI,
    .name = "udp-receive",
    .summary = "receives datagrams of `length` bytes, the newest or each in its turn: an output `data`, uint8",
    .source = "RFC 768; Linux: udp(7), socket(7)",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct udp_receive),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .await = await,
    .terminate = terminate,
};
