/** igps
 *
 * Receives planar positions of an indoor positioning system (Metris/Nikon iGPS) as UDP datagrams of two doubles, y
 * before x, in m.
 *
 * Failure: The flag is 0 once no position came for `timeout`, and from a datagram on whose numbers are not finite or
 * beyond `range`: by that the system says that it does not see the robot. While the flag is 0 the values stay the last
 * good ones, and `age` grows. Datagrams of another length or sender are counted in `refused` and change nothing. The
 * journal says once why there is no position.
 *
 * With `keys` each datagram carries 40 bytes more, which prove that it is the sender's and new; `make positions` on a
 * station appends them. A datagram without a right proof is not taken. It is counted in `refused` if it lacks the 40
 * bytes, in `forged` if they are wrong, and in `replayed` if it came before. The first datagram after a start of either
 * side is counted in `replayed`, too: the sender is asked, with 40 bytes, to prove that its datagrams are new.
 */
#include "core/udp.h"
#include "igps_datagram.h"

#include <flotilla/driver.h>
#include <flotilla/sensor.h>

struct igps {
    UDP_RECEIVER_MEMBERS;
    UDP_KEYS_MEMBER;
    int byte_order;
    double range;
    double timeout;
};

static const struct fl_parameter parameters[] = {
    UDP_RECEIVER_PARAMETERS(struct igps),
    UDP_KEYS_PARAMETER(struct igps),
    FL_PARAMETER(struct igps, byte_order, .default_value = "little-endian", .choices = "little-endian|big-endian",
                 .summary = "order of the bytes of a number; the iGPS computer is a PC, so least significant first"),
    FL_PARAMETER(struct igps, range, .default_value = "100", .min = 0, .max = 1e6, .unit = "m",
                 .summary = "greatest plausible coordinate, either sign"),
    FL_SENSOR_TIMEOUT(struct igps, "0.1"),
};

static const struct fl_port outputs[] = {
    {.name = "position", .type = FL_DOUBLE, .width = 2, .unit = "m", .summary = "x and y, the last good ones"},
    FL_SENSOR_OUTPUTS,
    UDP_RECEIVER_OUTPUTS,
    UDP_KEYS_OUTPUTS,
};

enum { POSITION, FLAG, AGE, SEQUENCE, DROPPED, REFUSED, SENDER, FORGED };
enum { PATIENCE_S = 5 }; /* without a datagram, before that is logged */

struct state {
    struct udp_receiver receiver;
    struct fl_sensor sensor;
    struct fl_step_reasons *reasons;
    uint32_t refused;    /* before this step */
    uint32_t forged;     /* likewise */
    int64_t received_ns; /* time of the last step that took a datagram, or of the first step */
};

static int configure(struct fl_block *block)
{
    const struct igps *igps = block->parameters;
    if (udp_receiver_check(block, igps->local_address, igps->from) != FL_OK)
        return FL_FAILED;
    return udp_check_keys(block, "from", igps->keys, IGPS_BYTES, igps->from);
}

static int start(struct fl_block *block)
{
    const struct igps *igps = block->parameters;
    struct state *state = block->state;
    fl_sensor_begin(&state->sensor);
    state->reasons = fl_step_reasons_start(block);
    if (!state->reasons)
        return FL_FAILED;
    return udp_receiver_open(&state->receiver, block, igps->local_address, igps->port, igps->interface, igps->from,
                             igps->failover, IGPS_BYTES, igps->keys);
}

/* Why there is no position; NULL: only that none came just now. */
static const char *reason_of(const struct state *state, const struct fl_block *block, bool unseen)
{
    if (unseen)
        return "the system does not see the robot: a position is not a number, or farther than `range`; with another "
               "`byte_order` all are";
    if (state->receiver.forged != state->forged)
        return "what comes proves no sender: it is forged, or its sender has another key than `keys`";
    if (state->receiver.refused != state->refused)
        return state->receiver.authenticated
                   ? "what comes is refused: it has not 16 bytes and 40 of a proof, or its sender is not in `from`"
                   : "what comes is refused: it has not 16 bytes, or its sender is not in `from`";
    if (block->release_ns - state->received_ns > PATIENCE_S * INT64_C(1000000000))
        return "no position comes: start the program that sends them to this port";
    return NULL;
}

static int step(struct fl_block *block)
{
    const struct igps *igps = block->parameters;
    struct state *state = block->state;
    uint8_t bytes[IGPS_BYTES];
    int64_t arrived_ns;
    struct udp_budget budget = udp_budget_of(block);
    bool unseen = false;
    state->refused = state->receiver.refused;
    state->forged = state->receiver.forged;
    if (block->step == 0)
        state->received_ns = block->release_ns;
    while (udp_receive(&state->receiver, bytes, &arrived_ns, &budget)) {
        state->received_ns = block->release_ns;
        struct igps_position position;
        /* A datagram with an impossible number means that the system does not see the robot. A datagram of another
         * length is not from the system, and means nothing. */
        if (!igps_read(bytes, sizeof bytes, (enum igps_byte_order)igps->byte_order, igps->range, &position)) {
            fl_sensor_invalidate(&state->sensor);
            unseen = true;
            continue;
        }
        ((double *)block->out[POSITION])[0] = position.x;
        ((double *)block->out[POSITION])[1] = position.y;
        fl_sensor_update(&state->sensor, arrived_ns, state->sensor.sequence + 1);
    }
    fl_sensor_outputs(&state->sensor, block, FLAG, true, igps->timeout);
    udp_receiver_outputs(&state->receiver, block, DROPPED);
    udp_keys_outputs(&state->receiver, block, FORGED);
    const char *reason = FL_OUT(block, FLAG, bool) ? NULL : reason_of(state, block, unseen);
    if (reason)
        fl_step_reasons_log(state->reasons, reason);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    fl_step_reasons_stop(state->reasons);
    udp_receiver_close(&state->receiver);
}

FL_BLOCK(igps) = {
    .abi = FL_ABI,
    .name = "igps",
    .summary = "planar position from an indoor positioning system (Metris/Nikon iGPS) by UDP",
    .source = "no public format: 16 bytes, Y then X as IEEE 754 doubles in m, packed on the iGPS computer",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct igps),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .terminate = terminate,
};
