/** epos2
 *
 * Drives a motor by a Maxon EPOS2 controller on a CAN bus. The block configures the drive from any state, enables it,
 * and commands it once a step. A step takes what the kernel has stamped and queued, and hands over what is to be sent;
 * neither can block.
 *
 * Equations:
 *   position in rad = quadrature counts·2π/(counts·gear)
 *   motor speed in rpm = gear·60/(2π)·speed of the gear's output in rad/s
 *
 * Failure: A command whose `age` is beyond `timeout`, or that is not finite, stops the motor by a quick stop. When the
 * task ends, in whatever way, it does, too; the power is taken off once the motor stands, after 0.8 s at the latest. A
 * task that cannot do so is noticed by the drive, which stops the motor after `heartbeat` without a sign of the block.
 * The flag is 0 while the drive is not in operation, silent for longer than `heartbeat`, or has sent no values for
 * `timeout`, and while the interface is missing or down. While the flag is 0 the values stay the last good ones, and
 * `age` grows. After a fault, or after the drive or the bus was lost, the motor stays off until `enable` goes from 0 to
 * 1, or comes back by itself with `restart: automatic`. The journal says the first cause. With `homing`, `enabled` is 0
 * until the drive has found its home. A search that fails or exceeds `homing_timeout` switches the motor off until
 * `enable` goes from 0 to 1, whatever `restart` is, and the journal names it.
 */
#define _GNU_SOURCE
#include "epos2.h"
#include "epos2_text.h"
#include "socket.h"
#include "sync.h"

#include <flotilla/sensor.h>
#include <math.h>
#include <time.h>

struct epos2_block {
    const char *interface;
    int64_t node, master;
    int mode;
    double counts, gear, heartbeat, max_velocity, acceleration, stop_deceleration, max_current, timeout;
    int fault_reset, restart, sync;
    int64_t homing;
    double homing_speed, homing_current, homing_offset, homing_timeout;
};

struct state {
    struct can_socket can;
    struct can_sync sync;
    struct epos2 drive;
    struct fl_sensor sensor;
    uint32_t connections;       /* of the interface, that the drive was begun on */
    struct fl_ring troubles;    /* from the step to the thread, for the journal */
    struct epos2_trouble known; /* the step has put into it */
    struct epos2_trouble now, logged;
    int64_t since_ns;        /* of `now` */
    _Atomic int64_t safe_ns; /* the quick stop at the end was sent; 0: it was not. From then on the drive is the
                                thread's, and no step's */
    bool ended;              /* the last frames were sent */
};

#define RPM (60 / (2 * 3.14159265358979323846)) /* of one rad/s */

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct epos2_block, interface, .flags = FL_EXCLUSIVE | FL_CAN_INTERFACE, .default_value = "can0",
                 .summary = "network interface of the bus"),
    FL_PARAMETER(struct epos2_block, node, .flags = FL_EXCLUSIVE, .min = 1, .max = 127,
                 .summary = "the drive's node address"),
    FL_PARAMETER(struct epos2_block, master, .default_value = "127", .min = 1, .max = 127,
                 .summary = "node address under which this block sends heartbeats: another for each drive"),
    FL_PARAMETER(struct epos2_block, mode, .choices = "position|velocity|current|profile-position|profile-velocity",
                 .summary = "what the target is"),
    FL_PARAMETER(struct epos2_block, counts, .default_value = "2000", .min = 1, .max = 1e9,
                 .summary = "quadrature counts of a turn of the motor: four times the encoder's pulses"),
    FL_PARAMETER(struct epos2_block, gear, .default_value = "1", .min = 1e-6, .max = 1e6,
                 .summary = "turns of the motor for one of the gear's output, where target and outputs are measured"),
    FL_PARAMETER(struct epos2_block, heartbeat, .default_value = "0.1", .min = 0.006, .max = 60, .unit = "s",
                 .summary =
                     "longest silence between drive and block: each sends a heartbeat four times in it, of which "
                     "two in a row may be lost"),
    FL_PARAMETER(struct epos2_block, max_velocity, .default_value = "0", .min = 0, .max = 1e6, .unit = "rad/s",
                 .summary = "limit of velocity targets and profiles; 0 leaves what the drive has stored"),
    FL_PARAMETER(struct epos2_block, acceleration, .default_value = "0", .min = 0, .max = 1e6, .unit = "rad/s²",
                 .summary = "of profiles, both ways, and of homing; 0 leaves what the drive has stored"),
    FL_PARAMETER(struct epos2_block, stop_deceleration, .default_value = "0", .min = 0, .max = 1e6, .unit = "rad/s²",
                 .summary = "of a quick stop; 0 leaves what the drive has stored"),
    FL_PARAMETER(struct epos2_block, max_current, .default_value = "0", .min = 0, .max = 32.767, .unit = "A",
                 .summary = "limit of the output current; 0 leaves what the drive has stored"),
    FL_PARAMETER(struct epos2_block, timeout, .flags = FL_ACTUATOR_TIMEOUT, .default_value = "0.1", .min = 1e-6,
                 .max = 1e6, .unit = "s", .summary = "age from which a command, or a measurement, is too old"),
    FL_PARAMETER(struct epos2_block, fault_reset, .default_value = "enable", .choices = "enable|automatic",
                 .summary = "what resets a fault: `enable` going from 0 to 1, or also the block, once a second"),
    FL_PARAMETER(struct epos2_block, restart, .default_value = "enable", .choices = "enable|automatic",
                 .summary = "what switches the motor on again after a fault, or after the drive or the bus was lost: "
                            "`enable` going from 0 to 1, or also the block, as soon as it can"),
    FL_PARAMETER(struct epos2_block, sync, .default_value = "shared", .choices = "shared|none",
                 .summary = "who sends SYNC: one of the blocks on the interface with `shared`, whatever tasks of this "
                            "computer they are in, once in its period; or another computer on the bus"),
    FL_PARAMETER(struct epos2_block, homing, .default_value = "0", .min = -4, .max = 35,
                 .summary = "method by which the drive searches its home before it follows the target, unless it says "
                            "that it has one, object 6098: -4 and -3 an end stop by its current, at negative and "
                            "positive speed, 17 and 18 a limit switch there, 35 where it is; 0 for none"),
    FL_PARAMETER(struct epos2_block, homing_speed, .default_value = "0", .min = 0, .max = 1e6, .unit = "rad/s",
                 .summary = "of the search; 0 leaves what the drive has stored"),
    FL_PARAMETER(struct epos2_block, homing_current, .default_value = "0", .min = 0, .max = 32.767, .unit = "A",
                 .summary = "by which an end stop is felt; 0 leaves what the drive has stored"),
    FL_PARAMETER(struct epos2_block, homing_offset, .default_value = "0", .min = -1e6, .max = 1e6, .unit = "rad",
                 .summary = "from the end of the search, where the drive then goes, and the position is 0; an end stop "
                            "needs some"),
    FL_PARAMETER(struct epos2_block, homing_timeout, .default_value = "30", .min = 0.5, .max = 3600, .unit = "s",
                 .summary = "of the search"),
};

enum { TARGET, ENABLE, COMMAND_AGE, COMMAND_FLAG };
static const struct fl_port inputs[] = {
    {.name = "target", .type = FL_DOUBLE, .width = 1, .summary = "rad, rad/s or A, by `mode`"},
    {.name = "enable", .type = FL_BOOLEAN, .width = 1, .summary = "0: quick stop, then no power on the motor"},
    {.name = "age",
     .type = FL_DOUBLE,
     .width = 1,
     .unit = "s",
     .summary =
         "age of the command, which counts as none beyond `timeout`: the output `age` of its source, or 0 where it "
         "is constant"},
    {.name = "flag",
     .type = FL_BOOLEAN,
     .width = 1,
     .flags = FL_OPTIONAL,
     .summary = "1: `enable` is somebody's command; only such a 0 lets the motor begin after a start of the task's "
                "service. Without a wire each is"},
};

enum { POSITION, VELOCITY, CURRENT, STATUS, ERROR, ABORT, ENABLED, HOMED, FLAG };
static const struct fl_port outputs[] = {
    {.name = "position", .type = FL_DOUBLE, .width = 1, .unit = "rad", .summary = "of the gear's output"},
    {.name = "velocity", .type = FL_DOUBLE, .width = 1, .unit = "rad/s", .summary = "of the gear's output"},
    {.name = "current", .type = FL_DOUBLE, .width = 1, .unit = "A", .summary = "of the motor"},
    {.name = "status", .type = FL_UINT16, .width = 1, .summary = "status word, object 6041"},
    {.name = "error", .type = FL_UINT16, .width = 1, .summary = "error code of a fault; 0: none"},
    {.name = "abort",
     .type = FL_UINT32,
     .width = 1,
     .summary = "SDO abort code with which the drive refused its configuration; 0: it did not"},
    {.name = "enabled", .type = FL_BOOLEAN, .width = 1, .summary = "1: the motor follows the target"},
    {.name = "homed",
     .type = FL_BOOLEAN,
     .width = 1,
     .summary = "1: the position is that from the home, or `homing` is 0"},
    FL_SENSOR_OUTPUTS,
};

static uint32_t whole(double value, double limit)
{
    return (uint32_t)llround(value < limit ? value : limit);
}

static struct epos2_settings settings_of(const struct epos2_block *set)
{
    double rpm = RPM * set->gear;
    return (struct epos2_settings){
        .node = (uint8_t)set->node,
        .master = (uint8_t)set->master,
        .mode = (enum epos2_mode)set->mode,
        .heartbeat_ms = (uint16_t)lround(set->heartbeat * 1e3),
        .counts_per_rad = set->counts * set->gear * RPM / 60,
        .rpm_per_rad_s = rpm,
        .max_rpm = whole(set->max_velocity * rpm, INT32_MAX),
        .rpm_per_s = whole(set->acceleration * rpm, UINT32_MAX),
        .stop_rpm_per_s = whole(set->stop_deceleration * rpm, UINT32_MAX),
        .limit_ma = (uint16_t)lround(set->max_current * 1e3),
        .homing_method = (int8_t)set->homing,
        .homing_rpm = whole(set->homing_speed * rpm, INT32_MAX),
        .homing_ma = (uint16_t)lround(set->homing_current * 1e3),
        .homing_offset =
            (int32_t)lround(fmax(-2e9, fmin(2e9, set->homing_offset * set->counts * set->gear * RPM / 60))),
        .homing_ns = llround(set->homing_timeout * 1e9),
        .automatic_reset = set->fault_reset == 1,
        .automatic_restart = set->restart == 1,
    };
}

static int configure(struct fl_block *block)
{
    const struct epos2_block *set = block->parameters;
    if (set->node == set->master)
        return fl_fail(block, "node and master are both %d: each node on a bus has its own address", (int)set->node);
    if (llround(set->heartbeat * 1e9) < EPOS2_HEARTBEATS * block->period_ns)
        return fl_fail(block, "heartbeat %g s is shorter than %d periods: a drive that misses two steps would stop",
                       set->heartbeat, EPOS2_HEARTBEATS);
    return FL_OK;
}

static bool same(const struct epos2_trouble *a, const struct epos2_trouble *b)
{
    return a->cause == b->cause && a->code == b->code && a->index == b->index && a->sub == b->sub;
}

static void log_trouble(struct fl_block *block, const struct epos2_trouble *trouble)
{
    const struct epos2_block *set = block->parameters;
    int node = (int)set->node;
    switch (trouble->cause) {
    case EPOS2_NO_ANSWER:
        fl_warn(block, "drive %d does not answer: check its power, cable, node address and bit rate; retrying", node);
        break;
    case EPOS2_NO_HEARTBEAT:
        fl_warn(block, "drive %d: no heartbeat for %g s: check its power and cable; retrying", node, set->heartbeat);
        break;
    case EPOS2_ABORTED:
        fl_warn(block, "drive %d refuses object %04X:%02X: SDO abort code %08X, %s; retrying", node, trouble->index,
                trouble->sub, (unsigned)trouble->code, epos2_abort_text(trouble->code));
        break;
    case EPOS2_EMERGENCY:
        fl_warn(block, "drive %d has a fault: EMCY error code %04X, %s", node, (unsigned)trouble->code,
                epos2_error_text((uint16_t)trouble->code));
        break;
    case EPOS2_NOT_HOMED:
        fl_warn(block,
                trouble->code ? "drive %d did not find its home within %g s: check its switch or end stop; the motor "
                                "stays off until `enable` goes from 0 to 1"
                              : "drive %d says that its search for the home failed, status bit 13: check its switch or "
                                "end stop; the motor stays off until `enable` goes from 0 to 1",
                node, set->homing_timeout);
        break;
    case EPOS2_FINE:
    default:
        fl_log(block, "drive %d works again", node);
        break;
    }
}

/* For the thread: log a trouble once, even if it returns at once, as a fault does that is reset each second. */
static void watch(struct fl_block *block)
{
    const int64_t fine_ns = INT64_C(2000000000);
    const struct epos2_block *set = block->parameters;
    struct state *state = block->state;
    int64_t now_ns = fl_now_ns();
    if (set->sync == 0)
        can_sync_claim(&state->sync, set->interface);
    while (fl_ring_take(&state->troubles, &state->now)) {
        state->since_ns = now_ns;
        if (state->now.cause == EPOS2_FINE || same(&state->now, &state->logged))
            continue;
        log_trouble(block, &state->now);
        state->logged = state->now;
    }
    if (state->now.cause == EPOS2_FINE && state->logged.cause != EPOS2_FINE && now_ns - state->since_ns >= fine_ns) {
        log_trouble(block, &state->now);
        state->logged = state->now;
    }
}

/* Hand the trouble to the thread. If the ring is full, the next step does so. */
static void report(struct state *state)
{
    const struct epos2_trouble *trouble = &state->drive.trouble;
    if (!same(trouble, &state->known) && fl_ring_put(&state->troubles, trouble))
        state->known = *trouble;
}

/* Whether the bus takes them all. A frame that the queue refuses is not kept: the next step has newer ones. */
static bool send_all(struct state *state, const struct can_frame *frames, size_t count)
{
    bool sent = !atomic_load(&state->can.bus_off);
    for (size_t i = 0; i < count; i++)
        sent &= can_send(&state->can, &frames[i]);
    return sent;
}

static void show(struct fl_block *block, struct state *state)
{
    const struct epos2_block *set = block->parameters;
    const struct epos2 *drive = &state->drive;
    if (drive->sequence != state->sensor.sequence)
        fl_sensor_update(&state->sensor, drive->values_ns, drive->sequence);
    bool there = drive->phase == EPOS2_RUNNING && can_connected(&state->can) && !atomic_load(&state->can.bus_off);
    fl_sensor_outputs(&state->sensor, block, FLAG, there, set->timeout);
    FL_OUT(block, POSITION, double) = drive->values.position;
    FL_OUT(block, VELOCITY, double) = drive->values.velocity;
    FL_OUT(block, CURRENT, double) = drive->values.current;
    FL_OUT(block, STATUS, uint16_t) = drive->status_word;
    FL_OUT(block, ERROR, uint16_t) = drive->error_code;
    FL_OUT(block, ABORT, uint32_t) = drive->abort_code;
    FL_OUT(block, ENABLED, uint8_t) = FL_OUT(block, FLAG, bool) && epos2_enabled(drive);
    FL_OUT(block, HOMED, bool) = drive->status_known && epos2_homed(drive);
}

/* A drive that could not be reached may be in any state, so set it up again. */
static void follow_interface(struct state *state)
{
    uint32_t connections = atomic_load(&state->can.connections);
    if (connections != state->connections)
        epos2_lose(&state->drive);
    state->connections = connections;
}

/* Take what came; whether anything did. */
static bool take_all(struct state *state)
{
    struct can_frame frame;
    int64_t arrived_ns;
    int taken = 0;
    while (taken < SOCKET_BURST && can_receive(&state->can, &frame, &arrived_ns)) {
        epos2_receive(&state->drive, &frame, arrived_ns);
        taken++;
    }
    return taken > 0;
}

static int step(struct fl_block *block)
{
    const struct epos2_block *set = block->parameters;
    struct state *state = block->state;
    struct can_frame out[EPOS2_FRAMES];
    take_all(state);
    bool fresh = FL_IN(block, COMMAND_AGE, double) <= set->timeout, enable = FL_IN(block, ENABLE, uint8_t);
    bool commanded = fresh && (!fl_wired(block, COMMAND_FLAG) || FL_IN(block, COMMAND_FLAG, bool));
    struct epos2_command command = {.enable = fl_may_act(block, commanded && !enable) && enable,
                                    .sync = atomic_load(&state->sync.mine),
                                    .target = fresh ? FL_IN(block, TARGET, double) : (double)NAN};
    follow_interface(state);
    /* While the interface is missing, start nothing: frames queued by its driver would reach the drive late. */
    if (can_connected(&state->can))
        send_all(state, out, epos2_advance(&state->drive, block->release_ns, &command, out));
    report(state);
    show(block, state);
    return FL_OK;
}

static void safe(struct fl_block *block)
{
    struct state *state = block->state;
    struct can_frame out[EPOS2_FRAMES];
    if (!send_all(state, out, epos2_quick_stop(&state->drive, out)))
        fl_not_safe(block, "the drive could not be reached by the CAN bus");
    if (!atomic_load(&state->safe_ns))
        atomic_store(&state->safe_ns, fl_now_ns());
    can_end(&state->can);
}

/* After the quick stop, for all drives of the task at the same time: wait until the motor stands and its power is off,
 * or may be taken off. A drive that does not work, or works for an earlier program, is commanded again and again, as
 * long as it says anything. */
static void await_rest(struct fl_block *block)
{
    enum { AGAIN_MS = 100, SILENT_MS = 300, LONGEST_MS = 800 /* a watchdog waits for a second */ };
    const int64_t ms = 1000000;
    const struct epos2_block *set = block->parameters;
    struct state *state = block->state;
    const int64_t heartbeat_ns = llround(set->heartbeat * 1e9) / (2 * EPOS2_HEARTBEATS), most_ns = 10 * ms;
    const struct timespec nap = {.tv_nsec = (long)(heartbeat_ns < most_ns ? heartbeat_ns : most_ns)};
    struct can_frame out[EPOS2_FRAMES];
    const int64_t safe_ns = atomic_load(&state->safe_ns);
    int64_t now_ns = fl_now_ns(), heard_ns = now_ns, sent_ns = safe_ns;
    while (can_connected(&state->can) && now_ns - safe_ns < LONGEST_MS * ms) {
        bool works = state->drive.phase == EPOS2_RUNNING;
        if (take_all(state))
            heard_ns = now_ns;
        if (works ? !epos2_powered(&state->drive) : now_ns - heard_ns > SILENT_MS * ms)
            return;
        if (set->sync == 0)
            can_sync_claim(&state->sync, set->interface); /* who has sent it may have ended */
        if (works || now_ns - sent_ns > AGAIN_MS * ms) {
            const struct epos2_command off = {.sync = atomic_load(&state->sync.mine), .target = (double)NAN};
            sent_ns = now_ns;
            send_all(state, out,
                     works ? epos2_advance(&state->drive, now_ns, &off, out) : epos2_quick_stop(&state->drive, out));
        }
        nanosleep(&nap, NULL);
        now_ns = fl_now_ns();
    }
}

/* By the thread, because `terminate` of other blocks may take longer than a drive waits for a heartbeat. */
static void end(struct fl_block *block)
{
    struct state *state = block->state;
    struct can_frame out[EPOS2_FRAMES];
    if (atomic_load(&state->safe_ns))
        await_rest(block);
    send_all(state, out, epos2_shutdown(&state->drive, out));
    can_sync_release(&state->sync); /* for a drive that still turns */
    state->ended = true;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    can_join(&state->can);
    if (!state->ended)
        end(block);
    can_stop(&state->can);
}

static int start(struct fl_block *block)
{
    enum { TROUBLES = 16 };
    const struct epos2_block *set = block->parameters;
    struct state *state = block->state;
    struct epos2_settings settings = settings_of(set);
    uint32_t identifiers[EPOS2_IDENTIFIERS];
    struct can_filter filters[EPOS2_IDENTIFIERS];
    epos2_begin(&state->drive, &settings);
    epos2_identifiers(&settings, identifiers);
    for (size_t i = 0; i < EPOS2_IDENTIFIERS; i++)
        filters[i] = (struct can_filter){identifiers[i], CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG};
    void *troubles = fl_allocate(block, fl_ring_bytes(sizeof(struct epos2_trouble), TROUBLES));
    if (!troubles)
        return FL_FAILED;
    fl_ring_initialize(&state->troubles, troubles, sizeof(struct epos2_trouble), TROUBLES);
    fl_sensor_begin(&state->sensor);
    if (set->sync == 0)
        can_sync_claim(&state->sync, set->interface); /* the first block that starts */
    state->can.watch = watch;
    state->can.end = end;
    return can_start(block, &state->can, set->interface, filters, EPOS2_IDENTIFIERS);
}

FL_BLOCK(epos2) = {
    .abi = FL_ABI,
    .name = "epos2",
    .summary = "Maxon EPOS2 motor drive on a CAN bus",
    .source = "Maxon, EPOS2 Firmware Specification; CiA 301 4.2; CiA 402-2",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct epos2_block),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .safe = safe,
    .terminate = terminate,
};
