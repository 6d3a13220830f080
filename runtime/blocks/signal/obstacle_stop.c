/** obstacle-stop
 *
 * Slows a commanded motion so that the robot can always stop before what it sees, whatever is commanded. The curve
 * stays: rate of turn and speed are slowed alike. Turning on the spot is not slowed, because the robot is round.
 *
 * Equations:
 *   k = omega/v of the measured motion to omega/v of the commanded one;  a speed below 0.01 m/s has none of its own
 *   c = min(clearance of the curves in k, and of the next one in `curvatures` on either side)
 *   travelled = speed·age when clearances arrive, then the integral of the measured speed ahead
 *   free = max(c − margin − travelled, 0);  a = deceleration
 *   allowed = √((a·delay)² + 2·a·free) − a·delay;  from this speed `free` is needed to stop
 *   v = max(min(v, allowed), −backward);  omega = omega·(v allowed)/(v commanded), or omega where that is 0
 *
 * Failure: While the flag is 0, `age` is beyond `timeout`, or an input is not finite, v and omega are 0, and `limited`
 * is 1.
 */
#include <flotilla/block.h>
#include <math.h>

struct stop {
    struct fl_doubles curvatures;
    double deceleration, delay, margin, backward, timeout;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct stop, curvatures, .default_value = "0", .min = -1e3, .max = 1e3, .unit = "1/m",
                 .summary = "of the curves whose clearances come in, increasing; positive: to the left"),
    FL_PARAMETER(struct stop, deceleration, .flags = FL_TUNABLE | FL_SAFETY, .min = 1e-3, .max = 100, .unit = "m/s²",
                 .summary = "with which the robot surely stops: less than the limit that follows this block"),
    FL_PARAMETER(struct stop, delay, .flags = FL_TUNABLE | FL_SAFETY, .max = 10, .unit = "s",
                 .summary = "from this block's output to the wheels, and until newer clearances come"),
    FL_PARAMETER(struct stop, margin, .flags = FL_TUNABLE | FL_SAFETY, .max = 100, .unit = "m",
                 .summary = "that is left when the robot has stopped"),
    FL_PARAMETER(struct stop, backward, .flags = FL_TUNABLE | FL_SAFETY, .default_value = "0", .max = 100,
                 .unit = "m/s", .summary = "greatest speed back, where nothing is seen"),
    FL_PARAMETER(struct stop, timeout, .flags = FL_TUNABLE | FL_SAFETY, .default_value = "0.3", .min = 1e-3, .max = 10,
                 .unit = "s", .summary = "older clearances are none"),
};

enum { V, OMEGA, SPEED, RATE, FLAG, AGE, SEQUENCE, CLEARANCE };

static const struct fl_port inputs[] = {
    {.name = "v", .type = FL_DOUBLE, .width = 1, .unit = "m/s", .summary = "commanded; ahead"},
    {.name = "omega", .type = FL_DOUBLE, .width = 1, .unit = "rad/s", .summary = "commanded; anticlockwise"},
    {.name = "speed", .type = FL_DOUBLE, .width = 1, .unit = "m/s", .summary = "measured"},
    {.name = "rate", .type = FL_DOUBLE, .width = 1, .unit = "rad/s", .summary = "measured rate of turn"},
    {.name = "flag", .type = FL_BOOLEAN, .width = 1, .summary = "1: the clearances are good"},
    {.name = "age", .type = FL_DOUBLE, .width = 1, .unit = "s", .summary = "since the scan was taken"},
    {.name = "sequence", .type = FL_UINT32, .width = 1, .summary = "changes with new clearances"},
};

enum { OUT_V, OUT_OMEGA, LIMITED, FREE };

static const struct fl_port outputs[] = {
    {.name = "v", .type = FL_DOUBLE, .width = 1, .unit = "m/s", .summary = "v, slowed; zero on failure"},
    {.name = "omega", .type = FL_DOUBLE, .width = 1, .unit = "rad/s", .summary = "omega, slowed; zero on failure"},
    {.name = "limited", .type = FL_BOOLEAN, .width = 1, .summary = "1: the motion is not as commanded"},
    {.name = "free", .type = FL_DOUBLE, .width = 1, .unit = "m", .summary = "path that may be used for stopping"},
};

struct state {
    uint32_t sequence;
    double travelled;
};

static int configure(struct fl_block *block)
{
    const struct stop *set = block->parameters;
    for (size_t i = 1; i < set->curvatures.count; i++)
        if (!(set->curvatures.value[i] > set->curvatures.value[i - 1]))
            return fl_fail(block, "curvatures: %g does not increase to %g", set->curvatures.value[i - 1],
                           set->curvatures.value[i]);
    return fl_add_input(block, (struct fl_port){.name = "clearance",
                                                .type = FL_DOUBLE,
                                                .width = (uint32_t)set->curvatures.count,
                                                .unit = "m",
                                                .summary = "free path on each curve"});
}

/* Least clearance of the curves from `low` to `high`, and of the next one on either side. */
static double least(const struct stop *set, const double *clearance, double low, double high)
{
    size_t count = set->curvatures.count, from = 0, to = count - 1;
    while (from + 1 < count && set->curvatures.value[from + 1] <= low)
        from++;
    while (to > 0 && set->curvatures.value[to - 1] >= high)
        to--;
    double found = fmin(clearance[from], clearance[to]);
    for (size_t i = from; i <= to; i++)
        found = fmin(found, clearance[i]);
    return found;
}

static double clearance_of(struct fl_block *block)
{
    const double slow = 0.01; /* m/s */
    double v = FL_IN(block, V, double), speed = FL_IN(block, SPEED, double);
    double wanted = v > slow ? FL_IN(block, OMEGA, double) / v : 0;
    double now = speed > slow ? FL_IN(block, RATE, double) / speed : wanted;
    if (!(v > slow))
        wanted = now;
    return least(block->parameters, block->in[CLEARANCE], fmin(now, wanted), fmax(now, wanted));
}

/* Path since the scan. */
static double travelled(struct fl_block *block)
{
    struct state *state = block->state;
    double speed = fmax(FL_IN(block, SPEED, double), 0);
    if (FL_IN(block, SEQUENCE, uint32_t) != state->sequence)
        state->travelled = speed * fmax(FL_IN(block, AGE, double), 0);
    else
        state->travelled += speed * fl_interval_s(block);
    state->sequence = FL_IN(block, SEQUENCE, uint32_t);
    return state->travelled;
}

static int step(struct fl_block *block)
{
    const struct stop *set = block->parameters;
    double v = FL_IN(block, V, double), omega = FL_IN(block, OMEGA, double);
    bool finite =
        isfinite(v) && isfinite(omega) && isfinite(FL_IN(block, SPEED, double)) && isfinite(FL_IN(block, RATE, double));
    double path = finite ? clearance_of(block) - set->margin - travelled(block) : 0;
    double lag = set->deceleration * set->delay, free = fmax(path, 0), slowest, ahead;
    bool good = FL_IN(block, FLAG, uint8_t) && FL_IN(block, AGE, double) <= set->timeout && finite && isfinite(path);
    slowest = sqrt(lag * lag + 2 * set->deceleration * free) - lag;
    ahead = good ? fmax(fmin(v, slowest), -set->backward) : 0;
    FL_OUT(block, OUT_V, double) = ahead;
    FL_OUT(block, OUT_OMEGA, double) = !good ? 0 : ahead == v ? omega : omega * (ahead / v);
    FL_OUT(block, LIMITED, bool) = !good || ahead != v;
    FL_OUT(block, FREE, double) = good ? free : 0;
    return FL_OK;
}

FL_BLOCK(obstacle_stop) = {
    .abi = FL_ABI,
    .name = "obstacle-stop",
    .summary = "slows a commanded motion so that the robot can stop before what it sees",
    .source =
        "Fox, Burgard, Thrun, The Dynamic Window Approach to Collision Avoidance, section 4.1: admissible velocities",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct stop),
    .state_size = sizeof(struct state),
    .configure = configure,
    .step = step,
};
