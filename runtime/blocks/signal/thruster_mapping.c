/** thruster-mapping
 *
 * Maps force and torque to the on-times of on/off thrusters, with the least on-time in total.
 *
 * Thrusters only push, so the duties solve a linear programme. Its optimum lies at a basis, a choice of three
 * thrusters that alone make the command. All bases are inverted at start. A step tries each, with 9 multiplications,
 * so its time is bounded and the same for every command: 56 bases of eight thrusters.
 *
 * Equations:
 *   least Σ u_i with Σ u_i·a_i = (force_x, force_y, torque) and u_i ≥ 0
 *   a_i = force_i·(d_x, d_y, p_x·d_y − p_y·d_x), with position p and unit direction d of thruster i
 *   beyond the thrusters' strength, max(u_i) > 1: all u_i are divided by max(u_i), and saturated = 1
 *   on_time_i = u_i·steps, rounded to whole steps; below `minimum` it becomes that or, below its half, 0
 *   achieved = Σ a_i·on_time_i/control period
 *
 * Failure: A command that is not finite, or beyond 1e30, opens no valve and gives saturated 1 for its control period.
 * Thrusters that cannot make force and torque in every direction are refused when the task is loaded.
 */
#include <flotilla/block.h>
#include <math.h>
#include <string.h>

enum { AXES = 3, MOST = 16, BASES = MOST * (MOST - 1) * (MOST - 2) / 6 };
enum { FORCE_X, FORCE_Y, TORQUE };
enum { VALVES, ON_TIME, ACHIEVED, SATURATED };

static const char *const axis_names[] = {"force_x", "force_y", "torque"};

/* Rounding of a duty that is zero. */
static const double tolerance = 1e-9;

struct thruster_mapping {
    struct fl_doubles positions, directions, force;
    int64_t steps;
    double minimum;
};

struct basis {
    uint32_t thruster[AXES];
    double inverse[AXES][AXES];
};

struct mapping {
    uint32_t count;
    double column[MOST][AXES]; /* force and torque of each thruster */
    uint32_t base_count;
    struct basis *bases;
};

struct state {
    struct mapping mapping;
    int64_t minimum_steps;
    int64_t phase; /* steps since the control period began */
    int64_t on_steps[MOST];
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

static int make_columns(struct fl_block *block, struct mapping *mapping)
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
    mapping->count = (uint32_t)count;
    for (size_t i = 0; i < count; i++, position += 2, direction += 2) {
        double length = hypot(direction[0], direction[1]);
        double force = thrusters->force.value[thrusters->force.count == 1 ? 0 : i];
        if (!(length > 0))
            return fl_fail(block, "directions: thruster %zu pushes nowhere", i);
        mapping->column[i][FORCE_X] = force * direction[0] / length;
        mapping->column[i][FORCE_Y] = force * direction[1] / length;
        mapping->column[i][TORQUE] = force * (position[0] * direction[1] - position[1] * direction[0]) / length;
    }
    return FL_OK;
}

static void cross(const double a[AXES], const double b[AXES], double out[AXES])
{
    for (int i = 0; i < AXES; i++)
        out[i] = a[(i + 1) % AXES] * b[(i + 2) % AXES] - a[(i + 2) % AXES] * b[(i + 1) % AXES];
}

static double dot(const double a[AXES], const double b[AXES])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* Invert the matrix of three columns: its rows are the cross products over the determinant. */
static bool invert(const double a[AXES], const double b[AXES], const double c[AXES], double inverse[AXES][AXES])
{
    cross(b, c, inverse[0]);
    cross(c, a, inverse[1]);
    cross(a, b, inverse[2]);
    double determinant = dot(a, inverse[0]);
    if (fabs(determinant) <= tolerance * sqrt(dot(a, a) * dot(b, b) * dot(c, c)))
        return false;
    for (int i = 0; i < AXES; i++)
        for (int j = 0; j < AXES; j++)
            inverse[i][j] /= determinant;
    return true;
}

static void make_bases(struct mapping *mapping)
{
    for (uint32_t a = 0; a < mapping->count; a++)
        for (uint32_t b = a + 1; b < mapping->count; b++)
            for (uint32_t c = b + 1; c < mapping->count; c++) {
                struct basis *basis = &mapping->bases[mapping->base_count];
                *basis = (struct basis){.thruster = {a, b, c}};
                mapping->base_count +=
                    invert(mapping->column[a], mapping->column[b], mapping->column[c], basis->inverse);
            }
}

/* Find the duties of all thrusters that make `wanted` with the least sum. If that needs a duty above 1, find those that
 * make as much as possible in its direction. False if it cannot be made at all. */
static bool allocate(const struct mapping *mapping, const double wanted[AXES], double duty[MOST], bool *saturated)
{
    const struct basis *best = NULL;
    double best_peak = INFINITY, best_sum = INFINITY, best_duty[AXES] = {0};
    for (uint32_t i = 0; i < mapping->base_count; i++) {
        const struct basis *basis = &mapping->bases[i];
        double u[AXES] = {dot(basis->inverse[0], wanted), dot(basis->inverse[1], wanted),
                          dot(basis->inverse[2], wanted)};
        double most = fmax(fmax(u[0], u[1]), u[2]), least = fmin(fmin(u[0], u[1]), u[2]);
        double peak = fmax(most, 1), sum = u[0] + u[1] + u[2];
        /* Equal except for rounding: the first stays, so that the choice does not flicker. */
        bool better = peak < best_peak * (1 - tolerance) ||
                      (peak <= best_peak * (1 + tolerance) && sum < best_sum * (1 - tolerance));
        if (least < -tolerance * fmax(most, tolerance) || !better)
            continue;
        best = basis;
        best_peak = peak;
        best_sum = sum;
        memcpy(best_duty, u, sizeof u);
    }
    memset(duty, 0, MOST * sizeof *duty);
    *saturated = best && best_peak > 1 + tolerance;
    for (int i = 0; best && i < AXES; i++)
        duty[best->thruster[i]] = fmin(fmax(best_duty[i] / best_peak, 0), 1);
    return best != NULL;
}

/* Compute the geometry. The thrusters must be able to act in both directions of each axis; then they can make every
 * command. */
static int make_mapping(struct fl_block *block, struct mapping *mapping)
{
    double duty[MOST];
    bool saturated;
    mapping->bases = fl_allocate(block, (BASES + 1) * sizeof *mapping->bases);
    if (!mapping->bases || make_columns(block, mapping) != FL_OK)
        return FL_FAILED;
    make_bases(mapping);
    for (int axis = 0; axis < AXES; axis++) {
        for (int sign = -1; sign <= 1; sign += 2) {
            double wanted[AXES] = {0};
            wanted[axis] = sign;
            if (!allocate(mapping, wanted, duty, &saturated))
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
    struct mapping mapping = {0};
    if (make_mapping(block, &mapping) != FL_OK)
        return FL_FAILED;
    if (minimum_steps(block) > thrusters->steps)
        return fl_fail(block, "minimum %g s is longer than a control period of %g s", thrusters->minimum,
                       1e-9 * (double)(thrusters->steps * block->period_ns));
    const struct fl_port ports[] = {
        {.name = "valves", .type = FL_BOOLEAN, .width = mapping.count, .summary = "1: open in this step"},
        {.name = "on_time",
         .type = FL_DOUBLE,
         .width = mapping.count,
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
    return make_mapping(block, &state->mapping);
}

static int64_t whole_steps(const struct state *state, double steps)
{
    int64_t rounded = llround(steps);
    if (rounded >= state->minimum_steps)
        return rounded;
    return 2 * steps >= (double)state->minimum_steps ? state->minimum_steps : 0;
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
        allocate(&state->mapping, wanted, duty, &saturated);
    memset(achieved, 0, AXES * sizeof *achieved);
    for (uint32_t i = 0; i < state->mapping.count; i++) {
        state->on_steps[i] = whole_steps(state, duty[i] * (double)thrusters->steps);
        on_time[i] = 1e-9 * (double)(state->on_steps[i] * block->period_ns);
        for (int axis = 0; axis < AXES; axis++)
            achieved[axis] += state->mapping.column[i][axis] * (double)state->on_steps[i] / (double)thrusters->steps;
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
    for (uint32_t i = 0; i < state->mapping.count; i++)
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
