/** thruster-mapping
 *
 * Maps force and torque to the on-times of on/off thrusters, with the least on-time in total.
 *
 * A robot has more thrusters than the three that a force and a torque need, so the duties solve a linear programme. It
 * is solved exactly, in a time that depends on the number of thrusters alone: see allocation.h.
 *
 * What rounding takes or adds, a thruster owes to the next control period: less than a step, or half of `minimum` where
 * that is more. It opens no valve that the command leaves closed. So the mean over several control periods is what was
 * commanded, also with `steps: 1`; a period alone may differ, and turn the robot for a command of force.
 *
 * Equations:
 *   least Σ u_i with Σ u_i·a_i = (force_x, force_y, torque) and 0 ≤ u_i ≤ 1
 *   a_i = force_i·(d_x, d_y, p_x·d_y − p_y·d_x), with position p and unit direction d of thruster i
 *   beyond the thrusters' strength: as much as they can make in the direction of the command, and saturated = 1
 *   on_time_i = u_i·steps + owed_i, rounded to whole steps; below `minimum` it becomes that or, below its half, 0
 *   owed_i = what the rounding took from on_time_i or, negative, added to it, for the next control period
 *   achieved = Σ a_i·on_time_i/control period
 *
 * Failure: A command that is not finite, or beyond 1e30, opens no valve and gives saturated 1 for its control period;
 * after it nothing is owed.
 * Thrusters that cannot make force and torque in every direction are refused when the task is loaded.
 */
#include "blocks/signal/allocation.h"

#include <flotilla/block.h>
#include <math.h>
#include <string.h>

enum { AXES = ALLOCATION_AXES, MOST = ALLOCATION_MOST };
enum { FORCE_X, FORCE_Y, TORQUE };
enum { VALVES, ON_TIME, ACHIEVED, SATURATED };

static const char *const axis_names[] = {"force_x", "force_y", "torque"};

/* Rounding of numbers beside 1. */
static const double tolerance = 1e-9;

struct thruster_mapping {
    struct fl_doubles positions, directions, force;
    int64_t steps;
    double minimum;
};

struct state {
    struct allocation allocation;
    int64_t minimum_steps;
    int64_t phase; /* steps since the control period began */
    int64_t on_steps[MOST];
    double owed[MOST]; /* steps */
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct thruster_mapping, positions, .unit = "m",
                 .summary = "x and y of each thruster from the centre of mass, in the robot's axes"),
    FL_PARAMETER(struct thruster_mapping, directions,
                 .summary = "x and y of each thruster's push on the robot; the length does not matter"),
    FL_PARAMETER(struct thruster_mapping, force, .min = 1e-9, .max = 1e9, .unit = "N",
                 .summary = "of all thrusters, or of each"),
    FL_PARAMETER(struct thruster_mapping, steps, .default_value = "1", .min = 1, .max = 1000000,
                 .summary = "of a control period: a command is taken at its beginning, and the pulses lie in it"),
    FL_PARAMETER(struct thruster_mapping, minimum, .default_value = "0", .max = 3600, .unit = "s",
                 .summary = "on-time that a valve needs: shorter ones become this or, below its half, nothing"),
};

static const struct fl_port inputs[] = {
    {.name = "force_x", .type = FL_DOUBLE, .width = 1, .unit = "N", .summary = "wanted, in the robot's axes"},
    {.name = "force_y", .type = FL_DOUBLE, .width = 1, .unit = "N", .summary = "wanted, in the robot's axes"},
    {.name = "torque", .type = FL_DOUBLE, .width = 1, .unit = "N·m", .summary = "wanted, from x to y"},
};

static int make_columns(struct fl_block *block, struct allocation *allocation)
{
    const struct thruster_mapping *thrusters = block->parameters;
    const double *position = thrusters->positions.value, *direction = thrusters->directions.value;
    size_t count = thrusters->positions.count / 2;
    if (count < AXES + 1 || count > MOST || thrusters->positions.count % 2)
        return fl_fail(block, "positions: %zu numbers are not x and y of 4 to %d thrusters", thrusters->positions.count,
                       MOST);
    if (thrusters->directions.count != 2 * count)
        return fl_fail(block, "directions: %zu numbers for %zu thrusters", thrusters->directions.count, count);
    if (thrusters->force.count != 1 && thrusters->force.count != count)
        return fl_fail(block, "force: %zu numbers for %zu thrusters", thrusters->force.count, count);
    allocation->count = (uint32_t)count;
    for (size_t i = 0; i < count; i++, position += 2, direction += 2) {
        double length = hypot(direction[0], direction[1]);
        double force = thrusters->force.value[thrusters->force.count == 1 ? 0 : i];
        if (!(length > 0))
            return fl_fail(block, "directions: thruster %zu pushes nowhere", i);
        allocation->column[i][FORCE_X] = force * direction[0] / length;
        allocation->column[i][FORCE_Y] = force * direction[1] / length;
        allocation->column[i][TORQUE] = force * (position[0] * direction[1] - position[1] * direction[0]) / length;
    }
    return FL_OK;
}

/* Compute the geometry. The thrusters must be able to act in both directions of each axis; then they can make every
 * command. */
static int make_allocation(struct fl_block *block, struct allocation *allocation)
{
    if (make_columns(block, allocation) != FL_OK)
        return FL_FAILED;
    allocation_prepare(allocation);
    if (!allocation->facet_count)
        return fl_fail(block, "these thrusters all push along one line");
    for (int axis = 0; axis < AXES; axis++) {
        for (int sign = -1; sign <= 1; sign += 2) {
            double wanted[AXES] = {0};
            wanted[axis] = sign;
            if (!allocation_makes(allocation, wanted))
                return fl_fail(block, "these thrusters cannot make a %s %s alone", sign < 0 ? "negative" : "positive",
                               axis_names[axis]);
        }
    }
    return FL_OK;
}

static int64_t minimum_steps(const struct fl_block *block)
{
    const struct thruster_mapping *thrusters = block->parameters;
    return (int64_t)ceil(thrusters->minimum * 1e9 / (double)block->period_ns - tolerance);
}

static int configure(struct fl_block *block)
{
    const struct thruster_mapping *thrusters = block->parameters;
    struct allocation *allocation = fl_allocate(block, sizeof *allocation);
    if (!allocation || make_allocation(block, allocation) != FL_OK)
        return FL_FAILED;
    if (minimum_steps(block) > thrusters->steps)
        return fl_fail(block, "minimum %g s is longer than a control period of %g s", thrusters->minimum,
                       1e-9 * (double)(thrusters->steps * block->period_ns));
    const struct fl_port ports[] = {
        {.name = "valves", .type = FL_BOOLEAN, .width = allocation->count, .summary = "1: open in this step"},
        {.name = "on_time",
         .type = FL_DOUBLE,
         .width = allocation->count,
         .unit = "s",
         .summary = "of each valve in this control period"},
        {.name = "achieved",
         .type = FL_DOUBLE,
         .width = AXES,
         .unit = "N, N, N·m",
         .summary = "force and torque, the mean of this control period"},
        {.name = "saturated",
         .type = FL_BOOLEAN,
         .width = 1,
         .summary = "1: more was wanted than the thrusters have; they push in its direction, or rest if it is not "
                    "finite"},
    };
    for (size_t i = 0; i < sizeof ports / sizeof ports[0]; i++)
        if (fl_add_output(block, ports[i]) != FL_OK)
            return FL_FAILED;
    return FL_OK;
}

static int start(struct fl_block *block)
{
    struct state *state = block->state;
    state->minimum_steps = minimum_steps(block);
    return make_allocation(block, &state->allocation);
}

static int64_t whole_steps(const struct state *state, double steps, int64_t most)
{
    int64_t rounded = llround(steps);
    if (rounded >= state->minimum_steps)
        return rounded < 0 ? 0 : rounded < most ? rounded : most;
    return 2 * steps >= (double)state->minimum_steps ? state->minimum_steps : 0;
}

/* The steps that a thruster is on for in a control period. */
static int64_t on_steps(struct state *state, uint32_t thruster, double duty, int64_t period_steps)
{
    double steps = duty * (double)period_steps + state->owed[thruster];
    if (duty == 0)
        return 0;
    int64_t on = whole_steps(state, steps, period_steps);
    state->owed[thruster] = steps - (double)on;
    return on;
}

static void begin_period(struct fl_block *block)
{
    const struct thruster_mapping *thrusters = block->parameters;
    struct state *state = block->state;
    const double wanted[AXES] = {FL_IN(block, FORCE_X, double), FL_IN(block, FORCE_Y, double),
                                 FL_IN(block, TORQUE, double)};
    double duty[MOST] = {0}, *on_time = block->out[ON_TIME], *achieved = block->out[ACHIEVED];
    bool saturated = true;
    /* Limit the magnitude, too: products of the largest numbers are not finite. */
    if (fabs(wanted[0]) + fabs(wanted[1]) + fabs(wanted[2]) < 1e30)
        saturated = allocate(&state->allocation, wanted, duty) < 1 - tolerance;
    else
        memset(state->owed, 0, sizeof state->owed);
    memset(achieved, 0, AXES * sizeof *achieved);
    for (uint32_t i = 0; i < state->allocation.count; i++) {
        state->on_steps[i] = on_steps(state, i, duty[i], thrusters->steps);
        on_time[i] = 1e-9 * (double)(state->on_steps[i] * block->period_ns);
        for (int axis = 0; axis < AXES; axis++)
            achieved[axis] += state->allocation.column[i][axis] * (double)state->on_steps[i] / (double)thrusters->steps;
    }
    FL_OUT(block, SATURATED, bool) = saturated;
}

static int step(struct fl_block *block)
{
    const struct thruster_mapping *thrusters = block->parameters;
    struct state *state = block->state;
    bool *valves = block->out[VALVES];
    if (state->phase == 0)
        begin_period(block);
    for (uint32_t i = 0; i < state->allocation.count; i++)
        valves[i] = state->phase < state->on_steps[i];
    state->phase = (state->phase + 1) % thrusters->steps;
    return FL_OK;
}

FL_BLOCK(thruster_mapping) = {
    .abi = FL_ABI,
    .name = "thruster-mapping",
    .summary = "force and torque to pulses of on/off thrusters: outputs valves, on_time, achieved, saturated",
    .source = "fundamental theorem of linear programming: Dantzig, Linear Programming and Extensions, chapter 5",
    FL_TABLE(input, inputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct thruster_mapping),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
};
