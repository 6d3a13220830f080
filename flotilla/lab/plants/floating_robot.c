/* The floating robot as a block: moved by its valves to the present of each step, and measured there. */
#include "plant.h"

#include <flotilla/block.h>
#include <inttypes.h>
#include <string.h>

struct robot {
    double mass, inertia;
    struct fl_doubles positions, directions, force;
    double thrust_noise, minimum_on_time, opening_delay, closing_delay;
    struct fl_doubles tilt;
    double igps_noise, gyro_noise_deg_s, gyro_bias_deg_s;
    struct fl_doubles initial_pose, initial_velocity;
    int64_t seed;
};

/* Ranges are plant_ranges'. */
static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct robot, mass, .unit = "kg"),
    FL_PARAMETER(struct robot, inertia, .unit = "kg·m²", .summary = "about the vertical axis"),
    FL_PARAMETER(struct robot, positions, .unit = "m",
                 .summary = "x and y of each of eight thrusters from the centre of mass, in the robot's axes"),
    FL_PARAMETER(struct robot, directions,
                 .summary = "x and y of each thruster's push on the robot; the length does not matter"),
    FL_PARAMETER(struct robot, force, .unit = "N", .summary = "of all thrusters, or of each"),
    FL_PARAMETER(struct robot, thrust_noise, .default_value = "0",
                 .summary = "relative standard deviation of a thrust, drawn at each opening"),
    FL_PARAMETER(struct robot, minimum_on_time, .default_value = "0", .unit = "s",
                 .summary = "a valve that opens stays open for so long, whatever it is told"),
    FL_PARAMETER(struct robot, opening_delay, .default_value = "0", .unit = "s",
                 .summary = "from the command to the thrust"),
    FL_PARAMETER(struct robot, closing_delay, .default_value = "0", .unit = "s",
                 .summary = "from the command to its end"),
    FL_PARAMETER(struct robot, tilt, .default_value = "0", .unit = "m/s²",
                 .summary = "acceleration by the table's slope"),
    FL_PARAMETER(struct robot, igps_noise, .default_value = "0", .unit = "m",
                 .summary = "standard deviation of each axis"),
    FL_PARAMETER(struct robot, gyro_noise_deg_s, .default_value = "0", .unit = "°/s", .summary = "standard deviation"),
    FL_PARAMETER(struct robot, gyro_bias_deg_s, .default_value = "0", .unit = "°/s"),
    FL_PARAMETER(struct robot, initial_pose, .default_value = "0", .unit = "m, m, rad"),
    FL_PARAMETER(struct robot, initial_velocity, .default_value = "0", .unit = "m/s, m/s, rad/s"),
    FL_PARAMETER(struct robot, seed, .default_value = "1", .summary = "of all noise"),
};

static const struct fl_port inputs[] = {
    {.name = "valves",
     .type = FL_BOOLEAN,
     .width = PLANT_THRUSTERS,
     .flags = FL_DELAYED,
     .summary = "1: open; as they were told in the step before, since when the robot moved"},
};

enum { POSE, VELOCITY, IGPS, RATE, ON_TIME, SWITCHES };
static const struct fl_port outputs[] = {
    {.name = "pose", .type = FL_DOUBLE, .width = 3, .unit = "m, m, rad", .summary = "x, y, heading; from x to y"},
    {.name = "velocity", .type = FL_DOUBLE, .width = 3, .unit = "m/s, m/s, rad/s", .summary = "in the table's axes"},
    {.name = "igps", .type = FL_DOUBLE, .width = 2, .unit = "m", .summary = "x and y as measured"},
    {.name = "rate_deg_s",
     .type = FL_DOUBLE,
     .width = 1,
     .unit = "°/s",
     .summary = "turn rate as a DSP-3000 measures it: clockwise positive, seen from above"},
    {.name = "on_time", .type = FL_DOUBLE, .width = PLANT_THRUSTERS, .unit = "s", .summary = "of each valve so far"},
    {.name = "switches",
     .type = FL_UINT32,
     .width = PLANT_THRUSTERS,
     .summary = "how often each valve has opened or closed"},
};

struct state {
    struct plant plant;
    int64_t moved_ns; /* the release up to which it has */
};

static int copy(struct fl_block *block, const char *name, const struct fl_doubles *from, struct plant_parameters *plant)
{
    const struct plant_range *range = plant_ranges;
    while (strcmp(range->name, name) != 0)
        range++;
    bool uniform = range->uniform && from->count == 1;
    if (!uniform && from->count != range->count)
        return fl_fail(block, "parameter %s: %zu numbers, not %" PRIu32, name, from->count, range->count);
    for (uint32_t i = 0; i < range->count; i++)
        ((double *)plant)[range->offset + i] = from->value[uniform ? 0 : i];
    return FL_OK;
}

#define COPY(member) (copy(block, #member, &robot->member, plant) == FL_OK)

static int translate(struct fl_block *block, struct plant_parameters *plant)
{
    const struct robot *robot = block->parameters;
    char why[200];
    *plant = (struct plant_parameters){
        .mass = robot->mass,
        .inertia = robot->inertia,
        .thrust_noise = robot->thrust_noise,
        .minimum_on_time = robot->minimum_on_time,
        .opening_delay = robot->opening_delay,
        .closing_delay = robot->closing_delay,
        .igps_noise = robot->igps_noise,
        .gyro_noise_deg_s = robot->gyro_noise_deg_s,
        .gyro_bias_deg_s = robot->gyro_bias_deg_s,
        .seed = (double)robot->seed,
    };
    if (!COPY(positions) || !COPY(directions) || !COPY(force) || !COPY(tilt) || !COPY(initial_pose) ||
        !COPY(initial_velocity))
        return FL_FAILED;
    return plant_check(plant, why, sizeof why) ? FL_OK : fl_fail(block, "parameter %s", why);
}

static int configure(struct fl_block *block)
{
    struct plant_parameters plant;
    return translate(block, &plant);
}

static void write_outputs(struct fl_block *block, struct plant *plant)
{
    double *on_time = block->out[ON_TIME];
    memcpy(block->out[POSE], plant->motion.pose, sizeof plant->motion.pose);
    memcpy(block->out[VELOCITY], plant->motion.velocity, sizeof plant->motion.velocity);
    memcpy(block->out[SWITCHES], plant->account.switches, sizeof plant->account.switches);
    for (int i = 0; i < PLANT_THRUSTERS; i++)
        on_time[i] = (double)plant->account.on_time_ns[i] / 1e9;
    plant_igps(plant, block->out[IGPS]);
    FL_OUT(block, RATE, double) = plant_gyro_deg_s(plant);
}

static int initialize(struct fl_block *block)
{
    struct state *state = block->state;
    struct plant_parameters plant;
    if (translate(block, &plant) != FL_OK)
        return FL_FAILED;
    plant_begin(&state->plant, &plant);
    return FL_OK;
}

/* By the releases and not by the period: time passes in a step that was left out, too. */
static int step(struct fl_block *block)
{
    struct state *state = block->state;
    int64_t passed_ns = block->step ? block->release_ns - state->moved_ns : 0;
    state->moved_ns = block->release_ns;
    if (!plant_advance(&state->plant, passed_ns, block->in[0]))
        return fl_fail(block, "the robot cannot be moved over %g s at once", 1e-9 * (double)passed_ns);
    write_outputs(block, &state->plant);
    return FL_OK;
}

FL_BLOCK(floating_robot) = {
    .abi = FL_ABI,
    .name = "floating-robot",
    .summary = "rigid body on an air table with eight on/off thrusters, iGPS and gyro",
    .source = "plant.h",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct robot),
    .state_size = sizeof(struct state),
    .configure = configure,
    .initialize = initialize,
    .step = step,
};
