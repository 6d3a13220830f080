/* The floating robot as physics: a rigid body on an air table, pushed by eight on/off thrusters, seen by two sensors.
 *
 *   m · p̈ = R(θ) · Σ Fᵢ uᵢ + m · tilt        J · θ̈ = Σ τᵢ uᵢ
 *
 * World axes are the table's, the heading turns from x to y (counter-clockwise seen from above) and is not wrapped.
 * SI units throughout, but for the gyro's °/s; time is counted in whole nanoseconds, so that valves switch at the same
 * instants on every processor. Random numbers, too, are the same everywhere; motion differs between processors by
 * rounding alone (i386 from amd64 by 1e-12 in some minutes).
 *
 * No I/O, no globals, no allocation: a plant is one structure of the caller's. It is used by a block
 * (floating_robot.c) and by Python (plant.py), which read names and counts of the parameters from `plant_ranges`.
 *
 * The model is that of the published floating spacecraft simulators; floating_robot.yml says which figures are theirs.
 */
#ifndef PLANT_H
#define PLANT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { PLANT_THRUSTERS = 8, PLANT_STREAMS = 3 };

/* Longest time of one plant_advance(), which bounds its loop. */
#define PLANT_LONGEST_NS INT64_C(60000000000)

/* Doubles alone; `plant_ranges` says what each may be. */
struct plant_parameters {
    double mass;
    double inertia;                         /* about the vertical axis through the centre of mass */
    double positions[2 * PLANT_THRUSTERS];  /* x, y of each thruster from the centre of mass, in the robot's axes */
    double directions[2 * PLANT_THRUSTERS]; /* x, y of each one's push on the robot; the length does not matter */
    double force[PLANT_THRUSTERS];
    double thrust_noise;    /* relative standard deviation of a thrust, drawn at each opening; never below 0 thrust */
    double minimum_on_time; /* a valve that opens stays open for so long, whatever it is told */
    double opening_delay;   /* from the command to the thrust */
    double closing_delay;   /* from the command to its end */
    double tilt[2];         /* acceleration by the table's slope */
    double igps_noise;      /* standard deviation of each axis */
    double gyro_noise_deg_s;
    double gyro_bias_deg_s;
    double initial_pose[3];     /* x, y, heading */
    double initial_velocity[3]; /* x, y in the table's axes, turn rate */
    double seed;                /* a whole number */
};

/* What a parameter may be. */
struct plant_range {
    const char *name;
    const char *unit;
    uint32_t offset, count; /* in the structure, seen as an array of doubles */
    bool uniform;           /* one number may stand for all */
    double least, most;     /* inclusive, of each number */
};

extern const struct plant_range plant_ranges[];
extern const uint32_t plant_range_count;

struct plant_motion {
    double pose[3];     /* x m, y m, heading rad */
    double velocity[3]; /* x m/s, y m/s in the table's axes, turn rate rad/s */
};

/* What the books of energy and momentum are balanced with, since plant_begin(). */
struct plant_account {
    double work_thrusters;  /* J, on position and heading */
    double work_tilt;       /* J */
    double impulse[2];      /* N·s, by thrusters, in the table's axes */
    double angular_impulse; /* N·m·s, by thrusters */
    int64_t on_time_ns[PLANT_THRUSTERS];
    uint32_t switches[PLANT_THRUSTERS]; /* openings and closings */
};

/* The valve's present or last pulse: it is open from `opens_ns` until `closes_ns`. */
struct plant_valve {
    bool command, open;
    int64_t opens_ns, closes_ns;
    double thrust; /* N, of this pulse */
};

struct plant {
    struct plant_parameters parameters;
    struct plant_motion motion;
    struct plant_account account;
    int64_t now_ns; /* since plant_begin() */
    int64_t minimum_ns, opening_ns, closing_ns;
    double axis[PLANT_THRUSTERS][3]; /* force x, y and torque of each thruster for 1 N */
    struct plant_valve valve[PLANT_THRUSTERS];
    uint64_t stream[PLANT_STREAMS]; /* thrust, iGPS, gyro: how often one is read changes no other */
};

/* sizeof(struct plant), for callers in other languages. */
size_t plant_size(void);

/* Whether parameters are within their ranges. If not, `why` names the parameter, its value and what would be right. */
bool plant_check(const struct plant_parameters *parameters, char *why, size_t size);

/* Put the robot at its initial pose with all valves closed. Parameters have passed plant_check(). */
void plant_begin(struct plant *plant, const struct plant_parameters *parameters);

/* Command the valves (true: open) and let time pass: 0 to PLANT_LONGEST_NS. False, with nothing done, if it is not. */
bool plant_advance(struct plant *plant, int64_t duration_ns, const bool valves[PLANT_THRUSTERS]);

const struct plant_motion *plant_motion(const struct plant *plant);
const struct plant_account *plant_account(const struct plant *plant);

/* Position as iGPS measures it, in m; another deviate with each call. */
void plant_igps(struct plant *plant, double position[2]);

/* Turn rate as a DSP-3000 measures it: °/s, clockwise positive seen from above; another deviate with each call. */
double plant_gyro_deg_s(struct plant *plant);

/* The next number of SplitMix64 (Steele, Lea, Flood: Fast splittable pseudorandom number generators, 2014). */
uint64_t plant_random(uint64_t *state);

/* A deviate of mean 0 and standard deviation 1, nearly normal: the sum of twelve uniform numbers (Irwin-Hall). It ends
 * at 6, and is an exact multiple of 2^-16, so that no processor's rounding has a part in it. */
double plant_deviate(uint64_t *state);

#endif
