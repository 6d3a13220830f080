/* Three EPOS2 drives on a CAN interface, as a block between the bus and a plant's motors. It counts what passes on the
 * bus: bits of each frame with all stuff bits that there may be and the space after it (Davis, Burns, Bril, Lukkien,
 * Controller Area Network (CAN) schedulability analysis, 2007, equation 2). */
#define _GNU_SOURCE
#include "epos2_drive.h"
#include "wheeled.h"

#include <errno.h>
#include <flotilla/block.h>
#include <linux/can/raw.h>
#include <math.h>
#include <net/if.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

enum { DRIVES = WHEELED_AXES, BURST = 64, HOMING_FAILS = 1, NO_POWER = 2 };

struct drives {
    const char *interface;
    struct fl_doubles nodes;
    double counts, gear, torque_constant;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct drives, interface, .summary = "network interface of the bus"),
    FL_PARAMETER(struct drives, nodes, .min = 1, .max = 127, .summary = "address of each"),
    FL_PARAMETER(struct drives, counts, .default_value = "2000", .min = 1, .max = 1e9,
                 .summary = "of a turn of the motor"),
    FL_PARAMETER(struct drives, gear, .min = 1e-6, .max = 1e6, .summary = "turns of the motor for one of its output"),
    FL_PARAMETER(struct drives, torque_constant, .default_value = "0.025", .min = 1e-6, .max = 1e3, .unit = "N·m/A"),
};

enum { POSITION, SPEED, TORQUE, ERROR };
static const struct fl_port inputs[] = {
    {.name = "position", .type = FL_DOUBLE, .width = DRIVES, .unit = "rad", .summary = "of the gears' outputs"},
    {.name = "speed", .type = FL_DOUBLE, .width = DRIVES, .unit = "rad/s", .summary = "of the gears' outputs"},
    {.name = "torque", .type = FL_DOUBLE, .width = DRIVES, .unit = "N·m", .summary = "of the gears' outputs"},
    {.name = "error",
     .type = FL_DOUBLE,
     .width = DRIVES,
     .flags = FL_OPTIONAL,
     .summary =
         "code of a fault that the drive finds when this changes; 0: none; 1: no fault, but homing fails; 2: the "
         "drive has no power"},
};

enum { TARGET, ENABLE, MODE, FRAMES, BITS, LOST };
static const struct fl_port outputs[] = {
    {.name = "target", .type = FL_DOUBLE, .width = DRIVES, .summary = "as wheeled-robot takes it"},
    {.name = "enable", .type = FL_BOOLEAN, .width = DRIVES, .summary = "1: there is power on the motor"},
    {.name = "mode", .type = FL_UINT8, .width = DRIVES, .summary = "enum wheeled_mode"},
    {.name = "frames", .type = FL_UINT32, .width = 1, .summary = "on the bus so far"},
    {.name = "bits", .type = FL_UINT64, .width = 1, .summary = "of these, at most"},
    {.name = "lost", .type = FL_UINT32, .width = 1, .summary = "frames that could not be sent"},
};

struct state {
    int fd;
    bool open;
    struct drive drive[DRIVES];
    double error[DRIVES];
};

static int configure(struct fl_block *block)
{
    const struct drives *set = block->parameters;
    if (set->nodes.count != DRIVES)
        return fl_fail(block, "parameter nodes: %zu addresses, not %d", set->nodes.count, DRIVES);
    return FL_OK;
}

static int start(struct fl_block *block)
{
    const struct drives *set = block->parameters;
    struct state *state = block->state;
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(set->interface)};
    if (!address.can_ifindex)
        return fl_fail(block, "%s: %s", set->interface, strerror(errno));
    state->fd = socket(AF_CAN, SOCK_RAW | SOCK_NONBLOCK | SOCK_CLOEXEC, CAN_RAW);
    state->open = state->fd >= 0;
    if (!state->open || bind(state->fd, (struct sockaddr *)&address, sizeof address) < 0)
        return fl_fail(block, "%s: %s", set->interface, strerror(errno));
    return FL_OK;
}

static void count(struct fl_block *block, const struct can_frame *frame)
{
    FL_OUT(block, FRAMES, uint32_t)++;
    FL_OUT(block, BITS, uint64_t) += 47u + 8u * frame->len + (33u + 8u * frame->len) / 4;
}

static void send_all(struct fl_block *block, struct state *state, struct drive *drive)
{
    for (size_t i = 0; i < drive->out_count; i++) {
        if (send(state->fd, &drive->out[i], sizeof drive->out[i], MSG_DONTWAIT) == (ssize_t)sizeof drive->out[i])
            count(block, &drive->out[i]);
        else
            FL_OUT(block, LOST, uint32_t)++;
    }
    drive->out_count = 0;
}

static int32_t counts_of(const struct drives *set, double position)
{
    return (int32_t)lround(position * set->counts * set->gear / 6.28318530717958647693);
}

static void measure(struct fl_block *block, struct state *state)
{
    const struct drives *set = block->parameters;
    const double tau = 6.28318530717958647693;
    const double *position = block->in[POSITION], *speed = block->in[SPEED], *torque = block->in[TORQUE];
    const double *error = block->in[ERROR];
    for (int i = 0; i < DRIVES; i++) {
        struct drive *drive = &state->drive[i];
        drive->counts = counts_of(set, position[i]);
        drive->rpm = (int32_t)lround(speed[i] * set->gear * 60 / tau);
        drive->milliamperes = (int32_t)lround(1e3 * torque[i] / set->gear / set->torque_constant);
        drive->homing_fails = error[i] == HOMING_FAILS;
        if (state->error[i] == NO_POWER && error[i] != NO_POWER)
            drive_begin(drive, drive->node, block->release_ns, drive->counts);
        if (error[i] == NO_POWER)
            drive->mode = 0;
        if (error[i] != state->error[i] && error[i] > NO_POWER)
            drive_fail(drive, (uint16_t)error[i]);
        state->error[i] = error[i];
    }
}

static void demand(struct fl_block *block, const struct state *state)
{
    const struct drives *set = block->parameters;
    const double tau = 6.28318530717958647693;
    for (int i = 0; i < DRIVES; i++) {
        const struct drive *drive = &state->drive[i];
        double value = drive->demand;
        uint8_t mode = WHEELED_OFF;
        if (drive->mode == -1) {
            mode = WHEELED_POSITION;
            value *= tau / (set->counts * set->gear);
        } else if (drive->mode == -2) {
            mode = WHEELED_VELOCITY;
            value *= tau / 60 / set->gear;
        } else if (drive->mode == -3) {
            mode = WHEELED_TORQUE;
            value *= 1e-3 * set->torque_constant * set->gear;
        }
        ((double *)block->out[TARGET])[i] = mode ? value : 0;
        ((uint8_t *)block->out[MODE])[i] = mode;
        ((bool *)block->out[ENABLE])[i] = mode != WHEELED_OFF;
    }
}

static int step(struct fl_block *block)
{
    const struct drives *set = block->parameters;
    struct state *state = block->state;
    struct can_frame frame;
    for (int i = 0; !block->step && i < DRIVES; i++)
        drive_begin(&state->drive[i], (uint8_t)set->nodes.value[i], block->release_ns,
                    counts_of(set, ((const double *)block->in[POSITION])[i]));
    measure(block, state);
    for (int n = 0; n < BURST && recv(state->fd, &frame, sizeof frame, MSG_DONTWAIT) == (ssize_t)sizeof frame; n++) {
        count(block, &frame);
        for (int i = 0; i < DRIVES; i++) {
            if (state->error[i] == NO_POWER)
                continue;
            drive_take(&state->drive[i], &frame);
            send_all(block, state, &state->drive[i]);
        }
    }
    for (int i = 0; i < DRIVES; i++) {
        if (state->error[i] == NO_POWER)
            continue;
        drive_advance(&state->drive[i], block->release_ns);
        send_all(block, state, &state->drive[i]);
    }
    demand(block, state);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    if (state->open)
        close(state->fd);
    state->open = false;
}

FL_BLOCK(epos2_drives) = {
    .abi = FL_ABI,
    .name = "epos2-drives",
    .summary = "three EPOS2 drives on a CAN bus, the other end of the blocks epos2",
    .source = "epos2_drive.h",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct drives),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .terminate = terminate,
};
