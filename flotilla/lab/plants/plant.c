#include "plant.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

/* --- parameters --- */

#define LARGEST_SEED 9007199254740992.0 /* 2^53: whole numbers up to here are doubles */

#define RANGE(member, unit_, uniform_, least_, most_)                                                                  \
    {.name = #member,                                                                                                  \
     .unit = (unit_),                                                                                                  \
     .offset = offsetof(struct plant_parameters, member) / sizeof(double),                                             \
     .count = sizeof(((struct plant_parameters *)NULL)->member) / sizeof(double),                                      \
     .uniform = (uniform_),                                                                                            \
     .least = (least_),                                                                                                \
     .most = (most_)}

const struct plant_range plant_ranges[] = {
    RANGE(mass, "kg", false, 1e-3, 1e6),
    RANGE(inertia, "kg·m²", false, 1e-6, 1e6),
    RANGE(positions, "m", false, -100, 100),
    RANGE(directions, "", false, -1e3, 1e3),
    RANGE(force, "N", true, 0, 1e6),
    RANGE(thrust_noise, "", false, 0, 1),
    RANGE(minimum_on_time, "s", false, 0, 10),
    RANGE(opening_delay, "s", false, 0, 10),
    RANGE(closing_delay, "s", false, 0, 10),
    RANGE(tilt, "m/s²", true, -10, 10),
    RANGE(igps_noise, "m", false, 0, 10),
    RANGE(gyro_noise_deg_s, "°/s", false, 0, 375),
    RANGE(gyro_bias_deg_s, "°/s", false, -375, 375),
    RANGE(initial_pose, "m, m, rad", true, -1e3, 1e3),
    RANGE(initial_velocity, "m/s, m/s, rad/s", true, -100, 100),
    RANGE(seed, "", false, 0, LARGEST_SEED),
};
const uint32_t plant_range_count = sizeof plant_ranges / sizeof plant_ranges[0];

static bool check_ranges(const struct plant_parameters *parameters, char *why, size_t size)
{
    for (uint32_t i = 0; i < plant_range_count; i++) {
        const struct plant_range *range = &plant_ranges[i];
        for (uint32_t j = 0; j < range->count; j++) {
            double value = ((const double *)parameters)[range->offset + j];
            if (value >= range->least && value <= range->most) /* which NaN is not */
                continue;
            snprintf(why, size, "%s: %g is not from %g to %g%s%s", range->name, value, range->least, range->most,
                     *range->unit ? " " : "", range->unit);
            return false;
        }
    }
    return true;
}

bool plant_check(const struct plant_parameters *parameters, char *why, size_t size)
{
    if (!check_ranges(parameters, why, size))
        return false;
    for (int i = 0; i < PLANT_THRUSTERS; i++) {
        const double *direction = &parameters->directions[2 * i];
        if (hypot(direction[0], direction[1]) > 0)
            continue;
        snprintf(why, size, "directions: thruster %d pushes nowhere; give x and y of its push", i);
        return false;
    }
    if (parameters->seed != floor(parameters->seed)) {
        snprintf(why, size, "seed: %g is not a whole number", parameters->seed);
        return false;
    }
    return true;
}

/* --- random numbers --- */

enum { THRUST, IGPS, GYRO };

uint64_t plant_random(uint64_t *state)
{
    uint64_t z = *state += UINT64_C(0x9E3779B97F4A7C15);
    z = (z ^ z >> 30) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ z >> 27) * UINT64_C(0x94D049BB133111EB);
    return z ^ z >> 31;
}

double plant_deviate(uint64_t *state)
{
    int32_t sum = -6 * 0xFFFF; /* twelve times the mean of a uniform number of 16 bits */
    for (int i = 0; i < 3; i++)
        for (uint64_t bits = plant_random(state), j = 0; j < 4; j++, bits >>= 16)
            sum += (int32_t)(bits & 0xFFFF);
    return sum / 65536.0;
}

/* --- valves --- */

/* A pulse that has not ended goes on when the valve is told to open again. One that was told to end before it began
 * is as long as the minimum, or, where there is none, as what the delays leave of it. */
static void command(struct plant *plant, int i, bool open)
{
    struct plant_valve *valve = &plant->valve[i];
    if (valve->command == open)
        return;
    valve->command = open;
    if (!open) {
        int64_t earliest_ns = valve->opens_ns + plant->minimum_ns;
        valve->closes_ns = plant->now_ns + plant->closing_ns;
        if (valve->closes_ns < earliest_ns)
            valve->closes_ns = earliest_ns;
        return;
    }
    if (valve->closes_ns <= plant->now_ns) {
        double relative = 1 + plant->parameters.thrust_noise * plant_deviate(&plant->stream[THRUST]);
        valve->opens_ns = plant->now_ns + plant->opening_ns;
        valve->thrust = plant->parameters.force[i] * fmax(relative, 0);
    }
    valve->closes_ns = INT64_MAX;
}

static void switch_valves(struct plant *plant)
{
    for (int i = 0; i < PLANT_THRUSTERS; i++) {
        struct plant_valve *valve = &plant->valve[i];
        bool open = valve->opens_ns <= plant->now_ns && plant->now_ns < valve->closes_ns;
        plant->account.switches[i] += open != valve->open;
        valve->open = open;
    }
}

/* When the next valve switches, if before `end_ns`. */
static int64_t until(const struct plant *plant, int64_t end_ns)
{
    for (int i = 0; i < PLANT_THRUSTERS; i++) {
        const struct plant_valve *valve = &plant->valve[i];
        if (valve->opens_ns > plant->now_ns && valve->opens_ns < end_ns)
            end_ns = valve->opens_ns;
        if (valve->closes_ns > plant->now_ns && valve->closes_ns < end_ns)
            end_ns = valve->closes_ns;
    }
    return end_ns;
}

/* --- motion --- */

/* Between two switchings force and torque are constant in the robot's axes. So the heading is a parabola and exact;
 * velocity and position are integrals over it, which Gauss's method with three stages takes: of order 6 (at 10 rad/s a
 * substep errs by 1e-14 of what it adds), and work and kinetic energy agree to rounding whatever the substep, because
 * the method keeps quadratic invariants. Hairer, Nørsett, Wanner: Solving Ordinary Differential Equations I, II.7;
 * Geometric Numerical Integration, IV.2. */
enum { STAGES = 3 };
#define SUBSTEP_NS INT64_C(10000000)
#define ROOT15     3.87298334620741688518

static const double node[STAGES] = {0.5 - ROOT15 / 10, 0.5, 0.5 + ROOT15 / 10};
static const double weight[STAGES] = {5.0 / 18, 4.0 / 9, 5.0 / 18};
static const double stage[STAGES][STAGES] = {
    {5.0 / 36, 2.0 / 9 - ROOT15 / 15, 5.0 / 36 - ROOT15 / 30},
    {5.0 / 36 + ROOT15 / 24, 2.0 / 9, 5.0 / 36 - ROOT15 / 24},
    {5.0 / 36 + ROOT15 / 30, 2.0 / 9 + ROOT15 / 15, 5.0 / 36},
};

/* Force and torque of the open valves, in the robot's axes. */
static void thrust(const struct plant *plant, double force[3])
{
    memset(force, 0, 3 * sizeof *force);
    for (int i = 0; i < PLANT_THRUSTERS; i++)
        for (int axis = 0; plant->valve[i].open && axis < 3; axis++)
            force[axis] += plant->valve[i].thrust * plant->axis[i][axis];
}

/* Force in the table's axes at each stage; heading and turn rate after it. */
static void turn(struct plant *plant, double h, const double force[3], double world[STAGES][2])
{
    double *heading = &plant->motion.pose[2], *rate = &plant->motion.velocity[2];
    double acceleration = force[2] / plant->parameters.inertia;
    for (int i = 0; i < STAGES; i++) {
        double t = node[i] * h;
        double angle = *heading + t * (*rate + t * acceleration / 2);
        world[i][0] = cos(angle) * force[0] - sin(angle) * force[1];
        world[i][1] = sin(angle) * force[0] + cos(angle) * force[1];
    }
    double swept = h * (*rate + h * acceleration / 2);
    *heading += swept;
    *rate += h * acceleration;
    plant->account.angular_impulse += h * force[2];
    plant->account.work_thrusters += swept * force[2];
}

/* One axis of the table, under a force at each stage and the slope. */
static void shift(struct plant *plant, double h, int axis, double world[STAGES][2])
{
    double mass = plant->parameters.mass, tilt = plant->parameters.tilt[axis];
    double *position = &plant->motion.pose[axis], *velocity = &plant->motion.velocity[axis];
    double moved = 0, impulse = 0, work = 0;
    for (int i = 0; i < STAGES; i++) {
        double speed = *velocity;
        for (int j = 0; j < STAGES; j++)
            speed += h * stage[i][j] * (world[j][axis] / mass + tilt);
        moved += h * weight[i] * speed;
        impulse += h * weight[i] * world[i][axis];
        work += h * weight[i] * world[i][axis] * speed;
    }
    *position += moved;
    *velocity += impulse / mass + h * tilt;
    plant->account.impulse[axis] += impulse;
    plant->account.work_thrusters += work;
    plant->account.work_tilt += mass * tilt * moved;
}

static void move(struct plant *plant, int64_t duration_ns)
{
    double force[3], world[STAGES][2], h = 1e-9 * (double)duration_ns;
    thrust(plant, force);
    turn(plant, h, force, world);
    shift(plant, h, 0, world);
    shift(plant, h, 1, world);
    for (int i = 0; i < PLANT_THRUSTERS; i++)
        plant->account.on_time_ns[i] += plant->valve[i].open ? duration_ns : 0;
}

/* --- interface --- */

size_t plant_size(void)
{
    return sizeof(struct plant);
}

static int64_t nanoseconds(double seconds)
{
    return llround(1e9 * seconds);
}

void plant_begin(struct plant *plant, const struct plant_parameters *parameters)
{
    *plant = (struct plant){
        .parameters = *parameters,
        .minimum_ns = nanoseconds(parameters->minimum_on_time),
        .opening_ns = nanoseconds(parameters->opening_delay),
        .closing_ns = nanoseconds(parameters->closing_delay),
    };
    memcpy(plant->motion.pose, parameters->initial_pose, sizeof plant->motion.pose);
    memcpy(plant->motion.velocity, parameters->initial_velocity, sizeof plant->motion.velocity);
    for (int i = 0; i < PLANT_THRUSTERS; i++) {
        const double *position = &parameters->positions[2 * i], *direction = &parameters->directions[2 * i];
        double length = hypot(direction[0], direction[1]);
        plant->axis[i][0] = direction[0] / length;
        plant->axis[i][1] = direction[1] / length;
        plant->axis[i][2] = (position[0] * direction[1] - position[1] * direction[0]) / length;
    }
    uint64_t seed = (uint64_t)parameters->seed;
    for (int i = 0; i < PLANT_STREAMS; i++)
        plant->stream[i] = plant_random(&seed);
}

bool plant_advance(struct plant *plant, int64_t duration_ns, const bool valves[PLANT_THRUSTERS])
{
    if (duration_ns < 0 || duration_ns > PLANT_LONGEST_NS)
        return false;
    for (int i = 0; i < PLANT_THRUSTERS; i++)
        command(plant, i, valves[i]);
    switch_valves(plant);
    /* Each round is a whole substep, or ends where one of eight valves switches, which each does twice at most. */
    for (int64_t end_ns = plant->now_ns + duration_ns; plant->now_ns < end_ns;) {
        int64_t most_ns = plant->now_ns + SUBSTEP_NS;
        int64_t next_ns = until(plant, most_ns < end_ns ? most_ns : end_ns);
        move(plant, next_ns - plant->now_ns);
        plant->now_ns = next_ns;
        switch_valves(plant);
    }
    return true;
}

const struct plant_motion *plant_motion(const struct plant *plant)
{
    return &plant->motion;
}

const struct plant_account *plant_account(const struct plant *plant)
{
    return &plant->account;
}

void plant_igps(struct plant *plant, double position[2])
{
    for (int axis = 0; axis < 2; axis++)
        position[axis] = plant->motion.pose[axis] + plant->parameters.igps_noise * plant_deviate(&plant->stream[IGPS]);
}

double plant_gyro_deg_s(struct plant *plant)
{
    const double deg = 180 / 3.14159265358979323846;
    return plant->parameters.gyro_bias_deg_s - deg * plant->motion.velocity[2] +
           plant->parameters.gyro_noise_deg_s * plant_deviate(&plant->stream[GYRO]);
}
