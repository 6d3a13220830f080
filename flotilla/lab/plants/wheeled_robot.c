/* The wheeled robot as a block: moved by its drives to the present of each step, and measured there. */
#include "wheeled.h"

#include <flotilla/block.h>
#include <math.h>
#include <string.h>

struct robot {
    struct fl_doubles figures, walls;
    double scan_period;
    int64_t cluster, others;
};

/* As doubles in the order of wheeled_ranges: who writes the task has them from a file, by name. */
static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct robot, figures, .summary = "the parameters of wheeled.h, in its order"),
    FL_PARAMETER(struct robot, walls, .default_value = "", .unit = "m", .summary = "x, y of the ends of each"),
    FL_PARAMETER(struct robot, scan_period, .default_value = "0.1", .min = 1e-3, .max = 10, .unit = "s"),
    FL_PARAMETER(struct robot, cluster, .default_value = "1", .min = 1, .max = WHEELED_STEPS,
                 .summary = "steps that make one of `ranges`, the shortest of them"),
    FL_PARAMETER(struct robot, others, .default_value = "0", .max = WHEELED_OTHERS,
                 .summary = "robots of its kind that may be in the room"),
};

enum { TARGET, ENABLE, FAULT, MODE, OTHERS, THERE };
static const struct fl_port inputs[] = {
    {.name = "target",
     .type = FL_DOUBLE,
     .width = WHEELED_AXES,
     .flags = FL_DELAYED,
     .summary = "left, right, boom: rad/s, rad or N·m by mode; as told in the step before, since when it moved"},
    {.name = "enable", .type = FL_BOOLEAN, .width = WHEELED_AXES, .flags = FL_DELAYED, .summary = "0: no power"},
    {.name = "fault",
     .type = FL_BOOLEAN,
     .width = WHEELED_AXES,
     .flags = FL_OPTIONAL | FL_DELAYED,
     .summary = "1: the drive stops its motor, and is not enabled"},
    {.name = "mode",
     .type = FL_UINT8,
     .width = WHEELED_AXES,
     .flags = FL_OPTIONAL | FL_DELAYED,
     .summary = "enum wheeled_mode; without a wire velocity, velocity, position"},
};

enum { POSITION, SPEED, TORQUE, ENABLED, POSE, MOTION, SLIP, CONTACTS, IMPACT, LEAST, SCANS, MILLIMETRES, RANGES };
static const struct fl_port outputs[] = {
    {.name = "position", .type = FL_DOUBLE, .width = WHEELED_AXES, .unit = "rad", .summary = "by the encoders"},
    {.name = "speed", .type = FL_DOUBLE, .width = WHEELED_AXES, .unit = "rad/s", .summary = "of the gears' outputs"},
    {.name = "torque", .type = FL_DOUBLE, .width = WHEELED_AXES, .unit = "N·m", .summary = "of the gears' outputs"},
    {.name = "enabled", .type = FL_BOOLEAN, .width = WHEELED_AXES, .summary = "1: enable, and no fault"},
    {.name = "pose", .type = FL_DOUBLE, .width = 3, .unit = "m, m, rad", .summary = "x, y, heading; as it is"},
    {.name = "motion", .type = FL_DOUBLE, .width = 2, .unit = "m/s, rad/s", .summary = "as it is"},
    {.name = "slip", .type = FL_DOUBLE, .width = 2, .unit = "m/s", .summary = "of each wheel on the floor"},
    {.name = "contacts", .type = FL_UINT32, .width = 1, .summary = "how often it has run into a wall or a robot"},
    {.name = "impact", .type = FL_DOUBLE, .width = 1, .unit = "m/s", .summary = "the fastest of these"},
    {.name = "least", .type = FL_DOUBLE, .width = 1, .unit = "m", .summary = "least distance to these so far"},
    {.name = "scans", .type = FL_UINT32, .width = 1, .summary = "taken so far"},
    {.name = "millimetres",
     .type = FL_UINT16,
     .width = WHEELED_STEPS,
     .unit = "mm",
     .summary = "the last scan; 0: not measured"},
};

struct state {
    struct wheeled robot;
    int64_t moved_ns, turn_ns; /* of the last step, of the begin of the scanner's turn */
    int scanned;               /* steps before this one are measured in this turn */
    uint16_t scan[WHEELED_STEPS];
};

static uint32_t range_count(const struct robot *set)
{
    return (uint32_t)((WHEELED_STEPS + set->cluster - 1) / set->cluster);
}

static int configure(struct fl_block *block)
{
    const struct robot *set = block->parameters;
    char why[200];
    size_t wanted = sizeof(struct wheeled_parameters) / sizeof(double);
    struct wheeled_parameters figures;
    if (set->figures.count != wanted)
        return fl_fail(block, "parameter figures: %zu numbers, not %zu", set->figures.count, wanted);
    if (set->walls.count % 4)
        return fl_fail(block, "parameter walls: %zu numbers, not four of each wall", set->walls.count);
    memcpy(&figures, set->figures.value, sizeof figures);
    if (!wheeled_check(&figures, set->walls.value, set->walls.count / 4, why, sizeof why))
        return fl_fail(block, "parameter %s", why);
    if (set->others) {
        struct fl_port others = {.name = "others",
                                 .type = FL_DOUBLE,
                                 .width = (uint32_t)(3 * set->others),
                                 .flags = FL_DELAYED,
                                 .unit = "m, m, rad",
                                 .summary = "pose of each other robot"};
        struct fl_port there = {.name = "there",
                                .type = FL_BOOLEAN,
                                .width = (uint32_t)set->others,
                                .flags = FL_DELAYED,
                                .summary = "1: this one is in the room"};
        if (fl_add_input(block, others) != FL_OK || fl_add_input(block, there) != FL_OK)
            return FL_FAILED;
    }
    return fl_add_output(block, (struct fl_port){.name = "ranges",
                                                 .type = FL_DOUBLE,
                                                 .width = range_count(set),
                                                 .unit = "m",
                                                 .summary = "the last scan; not a number: not measured"});
}

static int initialize(struct fl_block *block)
{
    const struct robot *set = block->parameters;
    struct state *state = block->state;
    struct wheeled_parameters figures;
    memcpy(&figures, set->figures.value, sizeof figures);
    wheeled_begin(&state->robot, &figures, set->walls.value, set->walls.count / 4);
    for (uint32_t i = 0; i < range_count(set); i++)
        ((double *)block->out[RANGES])[i] = NAN;
    return FL_OK;
}

static void demands(struct fl_block *block, struct wheeled_demand demand[WHEELED_AXES])
{
    static const uint8_t usual[WHEELED_AXES] = {WHEELED_VELOCITY, WHEELED_VELOCITY, WHEELED_POSITION};
    const double *target = block->in[TARGET];
    const uint8_t *enable = block->in[ENABLE], *fault = block->in[FAULT];
    const uint8_t *mode = fl_wired(block, MODE) ? block->in[MODE] : usual;
    bool *enabled = block->out[ENABLED];
    for (int i = 0; i < WHEELED_AXES; i++) {
        enabled[i] = enable[i] && !fault[i] && isfinite(target[i]);
        demand[i] = (struct wheeled_demand){enable[i] ? mode[i] : WHEELED_OFF, target[i]};
        if (enable[i] && !enabled[i])
            demand[i] = (struct wheeled_demand){WHEELED_VELOCITY, 0};
    }
}

static void meet(struct fl_block *block)
{
    const struct robot *set = block->parameters;
    struct state *state = block->state;
    wheeled_part(&state->robot);
    for (int64_t i = 0; i < set->others; i++) {
        const double *pose = (const double *)block->in[OTHERS] + 3 * i;
        if (((const uint8_t *)block->in[THERE])[i])
            wheeled_meet(&state->robot, pose[0], pose[1]);
    }
}

static void publish(struct fl_block *block)
{
    const struct robot *set = block->parameters;
    struct state *state = block->state;
    uint16_t *millimetres = block->out[MILLIMETRES];
    double *ranges = block->out[RANGES];
    memcpy(millimetres, state->scan, sizeof state->scan);
    FL_OUT(block, SCANS, uint32_t)++;
    for (uint32_t i = 0; i < range_count(set); i++) {
        uint16_t shortest = 0;
        for (int64_t j = i * set->cluster; j < (i + 1) * set->cluster && j < WHEELED_STEPS; j++)
            if (millimetres[j] && (!shortest || millimetres[j] < shortest))
                shortest = millimetres[j];
        ranges[i] = shortest ? shortest / 1e3 : NAN;
    }
}

/* Measure what the scanner has turned to since the step before; the first scan is taken at once. More at once than that
 * would keep the drives, which are of the same task, waiting for 4 ms. */
static void scan(struct fl_block *block)
{
    const struct robot *set = block->parameters;
    struct state *state = block->state;
    int64_t period_ns = (int64_t)(1e9 * set->scan_period), turned_ns = block->release_ns - state->turn_ns;
    if (!block->step || turned_ns >= period_ns) {
        state->turn_ns = block->step && turned_ns < 2 * period_ns ? state->turn_ns + period_ns : block->release_ns;
        state->scanned = WHEELED_FIRST;
        turned_ns = block->step ? block->release_ns - state->turn_ns : period_ns;
    }
    int64_t due = WHEELED_FIRST + turned_ns * WHEELED_TURN / period_ns;
    int end = due > WHEELED_LAST ? WHEELED_LAST + 1 : (int)due;
    if (state->scanned >= end)
        return;
    wheeled_scan_part(&state->robot, state->scanned, end, state->scan);
    state->scanned = end;
    if (end > WHEELED_LAST)
        publish(block);
}

/* By the releases and not by the period: time passes in a step that was left out, too. */
static int step(struct fl_block *block)
{
    struct state *state = block->state;
    struct wheeled *robot = &state->robot;
    struct wheeled_demand demand[WHEELED_AXES];
    int64_t passed_ns = block->step ? block->release_ns - state->moved_ns : 0;
    state->moved_ns = block->release_ns;
    demands(block, demand);
    meet(block);
    if (!wheeled_advance(robot, passed_ns, demand))
        return fl_fail(block, "the robot cannot be moved over %g s at once", 1e-9 * (double)passed_ns);
    for (int i = 0; i < WHEELED_AXES; i++) {
        ((double *)block->out[POSITION])[i] = wheeled_counts(robot, i) / robot->parameters.counts_per_rad;
        ((double *)block->out[SPEED])[i] = robot->axis[i].speed;
        ((double *)block->out[TORQUE])[i] = robot->axis[i].torque;
    }
    memcpy(block->out[POSE], robot->pose, sizeof robot->pose);
    memcpy(block->out[MOTION], (const double[]){robot->speed, robot->rate}, 2 * sizeof(double));
    memcpy(block->out[SLIP], robot->slip, sizeof robot->slip);
    FL_OUT(block, CONTACTS, uint32_t) = robot->contacts;
    FL_OUT(block, IMPACT, double) = robot->impact;
    FL_OUT(block, LEAST, double) = robot->least;
    scan(block);
    return FL_OK;
}

FL_BLOCK(wheeled_robot) = {
    .abi = FL_ABI,
    .name = "wheeled-robot",
    .summary = "a robot on two driven wheels with a boom and a laser scanner, in a room",
    .source = "wheeled.h",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct robot),
    .state_size = sizeof(struct state),
    .configure = configure,
    .initialize = initialize,
    .step = step,
};
