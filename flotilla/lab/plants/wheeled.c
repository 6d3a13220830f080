#include "wheeled.h"

#include "plant.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#define GRAVITY      9.80665
#define LARGEST_SEED 9007199254740992.0 /* 2^53: whole numbers up to here are doubles */
#define SUBSTEP_NS   INT64_C(100000)

/* --- parameters --- */

#define RANGE(member, unit_, least_, most_)                                                                            \
    {.name = #member,                                                                                                  \
     .unit = (unit_),                                                                                                  \
     .offset = offsetof(struct wheeled_parameters, member) / sizeof(double),                                           \
     .count = sizeof(((struct wheeled_parameters *)NULL)->member) / sizeof(double),                                    \
     .least = (least_),                                                                                                \
     .most = (most_)}

/* The least mass, inertia and slip speed, and the most grip, are such that a substep is stable. */
const struct wheeled_range wheeled_ranges[] = {
    RANGE(mass, "kg", 1, 1e3),
    RANGE(inertia, "kg·m²", 0.05, 1e3),
    RANGE(body_radius, "m", 0.01, 10),
    RANGE(wheel_radius, "m", 0.01, 1),
    RANGE(track, "m", 0.05, 10),
    RANGE(wheel_inertia, "kg·m²", 0.002, 10),
    RANGE(wheel_torque, "N·m", 0, 1e3),
    RANGE(wheel_damping, "N·m·s", 0, 1),
    RANGE(grip, "", 0, 2),
    RANGE(wheel_load, "", 0, 1),
    RANGE(slip_speed, "m/s", 0.005, 1),
    RANGE(rolling, "N", 0, 100),
    RANGE(boom_inertia, "kg·m²", 1e-4, 10),
    RANGE(boom_torque, "N·m", 0, 1e3),
    RANGE(boom_load, "N·m", 0, 1e3),
    RANGE(boom_damping, "N·m·s", 0, 1),
    RANGE(boom_end, "rad", 0, 1e4),
    RANGE(boom_begin, "rad", 0, 1e4),
    RANGE(lag, "s", 0.002, 1),
    RANGE(position_gain, "1/s", 0, 100),
    RANGE(counts_per_rad, "", 1, 1e7),
    RANGE(scanner_x, "m", -10, 10),
    RANGE(range_noise, "m", 0, 1),
    RANGE(range_noise_relative, "", 0, 0.5),
    RANGE(initial_pose, "m, m, rad", -1e3, 1e3),
    RANGE(seed, "", 0, LARGEST_SEED),
};
const uint32_t wheeled_range_count = sizeof wheeled_ranges / sizeof wheeled_ranges[0];

bool wheeled_check(const struct wheeled_parameters *parameters, const double *walls, size_t count, char *why,
                   size_t size)
{
    for (uint32_t i = 0; i < wheeled_range_count; i++) {
        const struct wheeled_range *range = &wheeled_ranges[i];
        for (uint32_t j = 0; j < range->count; j++) {
            double value = ((const double *)parameters)[range->offset + j];
            if (value >= range->least && value <= range->most) /* which NaN is not */
                continue;
            snprintf(why, size, "%s: %g is not from %g to %g%s%s", range->name, value, range->least, range->most,
                     *range->unit ? " " : "", range->unit);
            return false;
        }
    }
    if (parameters->seed != floor(parameters->seed)) {
        snprintf(why, size, "seed: %g is not a whole number", parameters->seed);
        return false;
    }
    if (count > WHEELED_WALLS) {
        snprintf(why, size, "walls: %zu are more than %d", count, WHEELED_WALLS);
        return false;
    }
    for (size_t i = 0; i < 4 * count; i++) {
        if (!(fabs(walls[i]) <= 1e3)) {
            snprintf(why, size, "walls: %g is not from -1000 to 1000 m", walls[i]);
            return false;
        }
    }
    return true;
}

void wheeled_begin(struct wheeled *robot, const struct wheeled_parameters *parameters, const double *walls,
                   size_t count)
{
    uint64_t seed = (uint64_t)parameters->seed;
    *robot = (struct wheeled){.parameters = *parameters, .wall_count = (uint32_t)count};
    if (count)
        memcpy(robot->walls, walls, 4 * count * sizeof *walls);
    memcpy(robot->pose, parameters->initial_pose, sizeof robot->pose);
    robot->axis[WHEELED_BOOM].angle = fmin(parameters->boom_begin, parameters->boom_end);
    robot->stream = plant_random(&seed);
    robot->least = wheeled_nearest(robot);
}

bool wheeled_meet(struct wheeled *robot, double x, double y)
{
    if (robot->other_count == WHEELED_OTHERS)
        return false;
    robot->others[2 * robot->other_count] = x;
    robot->others[2 * robot->other_count + 1] = y;
    robot->other_count++;
    return true;
}

void wheeled_part(struct wheeled *robot)
{
    robot->other_count = 0;
}

/* --- motors --- */

static double clamped(double value, double limit)
{
    return fmax(-limit, fmin(limit, value));
}

/* Torque of a drive: PI, whose integral stops where the torque is at its limit. */
static double drive(struct wheeled_axis *axis, const struct wheeled_demand *demand, double inertia, double limit,
                    const struct wheeled_parameters *set, double h)
{
    double target = demand->target;
    if (demand->mode == WHEELED_OFF)
        axis->integral = 0;
    if (demand->mode == WHEELED_OFF)
        return 0;
    if (demand->mode == WHEELED_TORQUE)
        return clamped(target, limit);
    if (demand->mode == WHEELED_POSITION)
        target = (target - axis->angle) * set->position_gain;
    double gain = inertia / set->lag, error = target - axis->speed;
    double torque = gain * error + axis->integral;
    if (fabs(torque) < limit)
        axis->integral += gain * error * h / (4 * set->lag);
    return clamped(torque, limit);
}

static void move_boom(struct wheeled *robot, const struct wheeled_demand *demand, double h)
{
    const struct wheeled_parameters *set = &robot->parameters;
    struct wheeled_axis *boom = &robot->axis[WHEELED_BOOM];
    boom->torque = drive(boom, demand, set->boom_inertia, set->boom_torque, set, h);
    /* Its spindle holds the load by itself while the drive is off. */
    double load = demand->mode == WHEELED_OFF ? 0 : set->boom_load;
    boom->speed += h * (boom->torque - load - set->boom_damping * boom->speed) / set->boom_inertia;
    if (demand->mode == WHEELED_OFF)
        boom->speed = 0;
    boom->angle += h * boom->speed;
    if (boom->angle < 0 || boom->angle > set->boom_end) {
        boom->angle = boom->angle < 0 ? 0 : set->boom_end;
        boom->speed = 0;
    }
}

/* --- motion --- */

/* Force on the body by a wheel. */
static double roll_wheel(struct wheeled *robot, int side, const struct wheeled_demand *demand, double h)
{
    const struct wheeled_parameters *set = &robot->parameters;
    struct wheeled_axis *wheel = &robot->axis[side];
    double arm = (side == WHEELED_LEFT ? -0.5 : 0.5) * set->track, r = set->wheel_radius;
    double slip = r * wheel->speed - (robot->speed + arm * robot->rate);
    double force = set->grip * set->wheel_load * set->mass * GRAVITY / 2 * tanh(slip / set->slip_speed);
    double inertia = set->wheel_inertia + set->mass * r * r / 2; /* what the loop is tuned for */
    wheel->torque = drive(wheel, demand, inertia, set->wheel_torque, set, h);
    double before = wheel->speed;
    wheel->speed += h * (wheel->torque - r * force - set->wheel_damping * before) / set->wheel_inertia;
    wheel->angle += h * (before + wheel->speed) / 2;
    robot->slip[side] = slip;
    return force;
}

static double segment_distance(const double *wall, double x, double y)
{
    double along_x = wall[2] - wall[0], along_y = wall[3] - wall[1];
    double length = along_x * along_x + along_y * along_y;
    double t = length > 0 ? ((x - wall[0]) * along_x + (y - wall[1]) * along_y) / length : 0;
    t = fmax(0, fmin(1, t));
    return hypot(x - wall[0] - t * along_x, y - wall[1] - t * along_y);
}

double wheeled_nearest(const struct wheeled *robot)
{
    double nearest = INFINITY;
    for (uint32_t i = 0; i < robot->wall_count; i++)
        nearest = fmin(nearest, segment_distance(&robot->walls[(size_t)4 * i], robot->pose[0], robot->pose[1]));
    for (uint32_t i = 0; i < robot->other_count; i++) {
        const double *other = &robot->others[(size_t)2 * i];
        double between = hypot(other[0] - robot->pose[0], other[1] - robot->pose[1]);
        nearest = fmin(nearest, between - robot->parameters.body_radius);
    }
    return nearest - robot->parameters.body_radius;
}

/* A wall, or another robot, takes the speed of what runs into it, and stays where it is. */
static void touch(struct wheeled *robot, const double before[2])
{
    double nearest = wheeled_nearest(robot), x = robot->pose[0], y = robot->pose[1];
    memcpy(robot->pose, before, 2 * sizeof *before);
    bool into = nearest < 0 && nearest < wheeled_nearest(robot);
    if (!into) {
        robot->pose[0] = x;
        robot->pose[1] = y;
    }
    robot->least = fmin(robot->least, nearest);
    if (into) {
        robot->contacts += !robot->touching;
        robot->impact = fmax(robot->impact, fabs(robot->speed));
        robot->speed = 0;
    }
    robot->touching = nearest < 0;
}

static void move(struct wheeled *robot, const struct wheeled_demand *demand, double h)
{
    const struct wheeled_parameters *set = &robot->parameters;
    const double creep = 0.01; /* m/s, where rolling resistance sets in */
    double left = roll_wheel(robot, WHEELED_LEFT, &demand[WHEELED_LEFT], h);
    double right = roll_wheel(robot, WHEELED_RIGHT, &demand[WHEELED_RIGHT], h);
    double rolling = set->rolling * tanh(robot->speed / creep);
    double speed = robot->speed, rate = robot->rate, *pose = robot->pose, arm = set->track / 2;
    double scrub = set->rolling * arm * tanh(rate * arm / creep);
    robot->speed += h * (left + right - rolling) / set->mass;
    robot->rate += h * ((right - left) * arm - scrub) / set->inertia;
    double middle = pose[2] + h * (rate + robot->rate) / 4, moved = h * (speed + robot->speed) / 2;
    pose[0] += moved * cos(middle);
    pose[1] += moved * sin(middle);
    pose[2] += h * (rate + robot->rate) / 2;
    move_boom(robot, &demand[WHEELED_BOOM], h);
}

bool wheeled_advance(struct wheeled *robot, int64_t duration_ns, const struct wheeled_demand demand[WHEELED_AXES])
{
    if (duration_ns < 0 || duration_ns > WHEELED_LONGEST_NS)
        return false;
    const double before[2] = {robot->pose[0], robot->pose[1]};
    for (int64_t left_ns = duration_ns; left_ns > 0; left_ns -= SUBSTEP_NS)
        move(robot, demand, 1e-9 * (double)(left_ns < SUBSTEP_NS ? left_ns : SUBSTEP_NS));
    robot->now_ns += duration_ns;
    if (duration_ns > 0)
        touch(robot, before);
    return true;
}

int32_t wheeled_counts(const struct wheeled *robot, int axis)
{
    return (int32_t)floor(robot->axis[axis].angle * robot->parameters.counts_per_rad);
}

/* --- scanner --- */

double wheeled_cast(const struct wheeled *robot, double bearing)
{
    double angle = robot->pose[2] + bearing, nearest = INFINITY;
    double x = robot->pose[0] + robot->parameters.scanner_x * cos(robot->pose[2]);
    double y = robot->pose[1] + robot->parameters.scanner_x * sin(robot->pose[2]);
    double ray_x = cos(angle), ray_y = sin(angle);
    for (uint32_t i = 0; i < robot->wall_count; i++) {
        const double *wall = &robot->walls[(size_t)4 * i];
        double along_x = wall[2] - wall[0], along_y = wall[3] - wall[1];
        double to_x = wall[0] - x, to_y = wall[1] - y, cross = ray_x * along_y - ray_y * along_x;
        if (fabs(cross) < 1e-12) /* seen from its end */
            continue;
        double range = (to_x * along_y - to_y * along_x) / cross, at = (to_x * ray_y - to_y * ray_x) / cross;
        if (range >= 0 && at >= 0 && at <= 1)
            nearest = fmin(nearest, range);
    }
    for (uint32_t i = 0; i < robot->other_count; i++) {
        double to_x = robot->others[(size_t)2 * i] - x, to_y = robot->others[(size_t)2 * i + 1] - y;
        double along = to_x * ray_x + to_y * ray_y, beside = to_x * ray_y - to_y * ray_x;
        double radius = robot->parameters.body_radius;
        if (along >= 0 && fabs(beside) <= radius)
            nearest = fmin(nearest, fmax(0, along - sqrt(radius * radius - beside * beside)));
    }
    return nearest;
}

void wheeled_scan_part(struct wheeled *robot, int first, int end, uint16_t millimetres[WHEELED_STEPS])
{
    const double turn = 6.28318530717958647693, least = 0.02, most = 5.6; /* of a URG-04LX */
    const struct wheeled_parameters *set = &robot->parameters;
    for (int step = first; step < end; step++) {
        double range = wheeled_cast(robot, (step - WHEELED_FRONT) * turn / WHEELED_TURN);
        double noise = fmax(set->range_noise, set->range_noise_relative * range);
        if (range <= most)
            range += noise * plant_deviate(&robot->stream);
        millimetres[step - WHEELED_FIRST] = (uint16_t)(range >= least && range <= most ? lround(1e3 * range) : 0);
    }
}

void wheeled_scan(struct wheeled *robot, uint16_t millimetres[WHEELED_STEPS])
{
    wheeled_scan_part(robot, WHEELED_FIRST, WHEELED_LAST + 1, millimetres);
}
