/** trajectory
 *
 * Moves a set point along straight lines from way point to way point. It goes by the clock, so a step that was skipped
 * does not delay it.
 *
 * Equations:
 *   a, b: the points before and after; D: the time between them in s; t: the part of D that has passed, 0 to 1
 *   linear s = t;  cubic s = 3t² − 2t³;  quintic s = 10t³ − 15t⁴ + 6t⁵; the latter two rest at each way point
 *   position = a + s·(b − a),  velocity = s'·(b − a)/D,  acceleration = s''·(b − a)/D²
 *   D by `times`, or |b − a|/speed
 *
 * Failure: Points, times and speed that do not fit each other are refused when the task is loaded. An `elapsed` that
 * is not finite, negative, or beyond 1e9 s counts as 0. After the last point the position stays there, with `done` 1.
 */
#include <flotilla/block.h>
#include <math.h>
#include <string.h>

enum interpolation { LINEAR, CUBIC, QUINTIC };
enum { RESET, ELAPSED };
enum { POSITION, VELOCITY, ACCELERATION, DONE };
enum { LONGEST_S = 1000000000 }; /* that a begin may lie back */

struct trajectory {
    struct fl_doubles waypoints, times;
    int64_t dimensions;
    double speed;
    int interpolation;
};

struct state {
    size_t count;  /* way points */
    double *times; /* of each, s */
    size_t at;     /* way point that was passed last */
    int64_t begin_ns;
    bool begun;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct trajectory, waypoints,
                 .summary = "all coordinates of the first point, then of the second, ..."),
    FL_PARAMETER(struct trajectory, dimensions, .default_value = "1", .min = 1, .max = 64,
                 .summary = "coordinates of a point"),
    FL_PARAMETER(struct trajectory, times, .default_value = "", .max = INFINITY, .unit = "s",
                 .summary = "when each point is to be reached, increasing; or give `speed`"),
    FL_PARAMETER(struct trajectory, speed, .default_value = "0", .max = INFINITY, .unit = "1/s",
                 .summary = "mean speed along each line, in units of the coordinates; begins at once"),
    FL_PARAMETER(struct trajectory, interpolation, .default_value = "linear", .choices = "linear|cubic|quintic",
                 .summary = "linear: constant speed, turning at once; cubic, quintic: resting at each point, reaching "
                            "1.5 and 1.875 times the mean speed; the quintic's acceleration has no jumps"),
};

static const struct fl_port inputs[] = {
    {.name = "reset",
     .type = FL_BOOLEAN,
     .width = 1,
     .flags = FL_OPTIONAL,
     .summary = "1: waits at time zero, where it begins when this goes to 0"},
    {.name = "elapsed",
     .type = FL_DOUBLE,
     .width = 1,
     .flags = FL_OPTIONAL,
     .unit = "s",
     .summary = "it begins at this time instead: where others are already"},
};

/* The number of points, or 0 after fl_fail(). */
static size_t count_points(struct fl_block *block)
{
    const struct trajectory *trajectory = block->parameters;
    size_t dimensions = (size_t)trajectory->dimensions, count = trajectory->waypoints.count / dimensions;
    if (!count || trajectory->waypoints.count % dimensions) {
        fl_fail(block, "waypoints: %zu numbers are not points of %zu coordinates", trajectory->waypoints.count,
                dimensions);
        return 0;
    }
    if ((trajectory->times.count > 0) == (trajectory->speed > 0) && count > 1) {
        fl_fail(block, "give either times or speed");
        return 0;
    }
    if (trajectory->times.count && trajectory->times.count != count) {
        fl_fail(block, "%zu times for %zu waypoints", trajectory->times.count, count);
        return 0;
    }
    for (size_t i = 1; i < trajectory->times.count; i++) {
        if (trajectory->times.value[i] <= trajectory->times.value[i - 1]) {
            fl_fail(block, "times: %g is not after %g", trajectory->times.value[i], trajectory->times.value[i - 1]);
            return 0;
        }
    }
    return count;
}

static int configure(struct fl_block *block)
{
    const struct trajectory *trajectory = block->parameters;
    uint32_t width = (uint32_t)trajectory->dimensions;
    const struct fl_port ports[] = {
        {.name = "position", .type = FL_DOUBLE, .width = width, .summary = "the point to be at; at the end the last"},
        {.name = "velocity", .type = FL_DOUBLE, .width = width, .unit = "1/s", .summary = "its first derivative"},
        {.name = "acceleration", .type = FL_DOUBLE, .width = width, .unit = "1/s²", .summary = "its second"},
        {.name = "done", .type = FL_BOOLEAN, .width = 1, .summary = "1: the last point was reached"},
    };
    if (!count_points(block))
        return FL_FAILED;
    for (size_t i = 0; i < sizeof ports / sizeof ports[0]; i++)
        if (fl_add_output(block, ports[i]) != FL_OK)
            return FL_FAILED;
    return FL_OK;
}

static double length(const double *from, const double *to, size_t dimensions)
{
    double squares = 0;
    for (size_t i = 0; i < dimensions; i++)
        squares += (to[i] - from[i]) * (to[i] - from[i]);
    return sqrt(squares);
}

static int start(struct fl_block *block)
{
    const struct trajectory *trajectory = block->parameters;
    struct state *state = block->state;
    size_t dimensions = (size_t)trajectory->dimensions;
    const double *points = trajectory->waypoints.value;
    state->count = count_points(block);
    state->times = fl_allocate(block, state->count * sizeof(double));
    if (!state->times)
        return FL_FAILED;
    if (trajectory->times.count)
        memcpy(state->times, trajectory->times.value, state->count * sizeof(double));
    else
        for (size_t i = 1; i < state->count; i++)
            state->times[i] =
                state->times[i - 1] +
                length(points + (i - 1) * dimensions, points + i * dimensions, dimensions) / trajectory->speed;
    return FL_OK;
}

static void be_at(struct fl_block *block, size_t point)
{
    const struct trajectory *trajectory = block->parameters;
    const struct state *state = block->state;
    size_t dimensions = (size_t)trajectory->dimensions, bytes = dimensions * sizeof(double);
    memcpy(block->out[POSITION], trajectory->waypoints.value + point * dimensions, bytes);
    memset(block->out[VELOCITY], 0, bytes);
    memset(block->out[ACCELERATION], 0, bytes);
    FL_OUT(block, DONE, bool) = state->at + 1 == state->count;
}

static int initialize(struct fl_block *block)
{
    struct state *state = block->state;
    state->begun = false;
    state->at = 0;
    be_at(block, 0);
    FL_OUT(block, DONE, bool) = false;
    return FL_OK;
}

/* s of t, and its derivatives. */
static void interpolate(int interpolation, double t, double s[3])
{
    switch (interpolation) {
    case LINEAR:
        s[0] = t;
        s[1] = 1;
        s[2] = 0;
        break;
    case CUBIC:
        s[0] = t * t * (3 - 2 * t);
        s[1] = 6 * t * (1 - t);
        s[2] = 6 - 12 * t;
        break;
    case QUINTIC:
        s[0] = t * t * t * (10 - t * (15 - 6 * t));
        s[1] = 30 * t * t * (1 - t) * (1 - t);
        s[2] = 60 * t * (1 - t) * (1 - 2 * t);
        break;
    }
}

static void be_between(struct fl_block *block, size_t from, double time)
{
    const struct trajectory *trajectory = block->parameters;
    const struct state *state = block->state;
    size_t dimensions = (size_t)trajectory->dimensions;
    const double *a = trajectory->waypoints.value + from * dimensions, *b = a + dimensions;
    double duration = state->times[from + 1] - state->times[from], s[3] = {0};
    double *position = block->out[POSITION], *velocity = block->out[VELOCITY], *acceleration = block->out[ACCELERATION];
    interpolate(trajectory->interpolation, (time - state->times[from]) / duration, s);
    for (size_t i = 0; i < dimensions; i++) {
        position[i] = a[i] + s[0] * (b[i] - a[i]);
        velocity[i] = s[1] * (b[i] - a[i]) / duration;
        acceleration[i] = s[2] * (b[i] - a[i]) / (duration * duration);
    }
    FL_OUT(block, DONE, bool) = false;
}

static int step(struct fl_block *block)
{
    struct state *state = block->state;
    double elapsed = FL_IN(block, ELAPSED, double);
    if (FL_IN(block, RESET, uint8_t))
        return initialize(block);
    if (!state->begun)
        state->begin_ns = block->release_ns - (elapsed > 0 && elapsed <= LONGEST_S ? llround(elapsed * 1e9) : 0);
    state->begun = true;
    /* By the clock, not by the count of steps: a step that was skipped must not delay the robot against the others. */
    double time = 1e-9 * (double)(block->release_ns - state->begin_ns);
    while (state->at + 1 < state->count && state->times[state->at + 1] <= time)
        state->at++;
    if (state->at + 1 == state->count || time < state->times[0])
        be_at(block, state->at);
    else
        be_between(block, state->at, time);
    return FL_OK;
}

FL_BLOCK(trajectory) = {
    .abi = FL_ABI,
    .name = "trajectory",
    .summary = "moves a set point from way point to way point: outputs position, velocity, acceleration, done",
    .source = "Lynch, Park, Modern Robotics, section 9.2",
    FL_TABLE(input, inputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct trajectory),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .initialize = initialize,
    .step = step,
};
