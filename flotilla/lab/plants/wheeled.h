/* The wheeled robot as physics: two driven wheels on one axle that may slip, a body, an extendable boom, and a laser
 * scanner in a room of straight walls, with other robots of its kind as discs.
 *
 *   wheel   J_w · ω̇ = τ − r · F − d · ω,  F = μ · N · tanh((r·ω − g)/s),  g: speed of the axle over the floor there
 *   body    m · v̇ = F_l + F_r − c · tanh(v / 0.01 m/s),  J · Ω̇ = (F_r − F_l − c · tanh(Ω · b/2 / 0.01 m/s)) · b/2
 *           the axle does not slip sideways
 *   boom    J_b · φ̈ = τ_b − load − d_b · φ̇, between its end stops
 *   motor   a PI loop of speed with a limited torque, as a drive's inner loops; its time constant is `lag`
 *
 * Sources: Siegwart, Nourbakhsh, Scaramuzza, Introduction to Autonomous Mobile Robots, chapter 3, for the kinematics;
 * Pacejka, Tyre and Vehicle Dynamics, chapter 1, for a force that grows with slip and saturates at μ · N; Hokuyo,
 * URG-04LX specifications, for directions, range and accuracy. wheeled_robot.yml says which figures are published.
 *
 * Axes are the room's, the heading turns from x to y and is not wrapped. SI units; time is counted in whole
 * nanoseconds. No I/O, no globals, no allocation. The random numbers are plant.h's. Used by a block (wheeled_robot.c);
 * wheeled.py reads the names of the parameters from here.
 */
#ifndef WHEELED_H
#define WHEELED_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { WHEELED_LEFT, WHEELED_RIGHT, WHEELED_BOOM, WHEELED_AXES };
enum { WHEELED_WALLS = 256, WHEELED_OTHERS = 16 }; /* at most */

/* Directions of a URG-04LX: 1024 in a turn, of which it measures these; FRONT looks ahead. */
enum { WHEELED_FIRST = 44, WHEELED_LAST = 725, WHEELED_FRONT = 384, WHEELED_TURN = 1024 };
enum { WHEELED_STEPS = WHEELED_LAST - WHEELED_FIRST + 1 };

/* Longest time of one wheeled_advance(), which bounds its loop. */
#define WHEELED_LONGEST_NS INT64_C(1000000000)

/* Doubles alone; `wheeled_ranges` says what each may be. */
struct wheeled_parameters {
    double mass;        /* of the whole robot */
    double inertia;     /* about the vertical axis through the axle's middle, where the centre of mass is */
    double body_radius; /* of the disc that covers it */
    double wheel_radius;
    double track;          /* from wheel to wheel */
    double wheel_inertia;  /* of a wheel with gear and motor, as seen at the wheel */
    double wheel_torque;   /* most of a drive, at the wheel */
    double wheel_damping;  /* N·m·s, of gear and motor */
    double grip;           /* μ between wheel and floor */
    double wheel_load;     /* share of the weight on the two wheels; castors carry the rest */
    double slip_speed;     /* at which tanh(1) of the grip is used */
    double rolling;        /* N, resistance of castors and wheels */
    double boom_inertia;   /* at the gear's output */
    double boom_torque;    /* most of the drive */
    double boom_load;      /* N·m against extension */
    double boom_damping;   /* N·m·s */
    double boom_end;       /* rad of the gear's output at full extension; 0: retracted */
    double boom_begin;     /* rad, where it is at first */
    double lag;            /* s, of the drives' speed loop */
    double position_gain;  /* 1/s, of the drives' position loop */
    double counts_per_rad; /* of the encoders, at the gears' output */
    double scanner_x;      /* ahead of the axle's middle */
    double range_noise;    /* standard deviation of a range, at least */
    double range_noise_relative;
    double initial_pose[3]; /* m, m, rad */
    double seed;            /* a whole number */
};

struct wheeled_range {
    const char *name, *unit;
    uint32_t offset, count; /* in the structure, seen as an array of doubles */
    double least, most;     /* inclusive */
};

extern const struct wheeled_range wheeled_ranges[];
extern const uint32_t wheeled_range_count;

enum wheeled_mode { WHEELED_OFF, WHEELED_VELOCITY, WHEELED_POSITION, WHEELED_TORQUE };

/* What a drive's inner loops are told: rad/s, rad or N·m of the gear's output, by mode. */
struct wheeled_demand {
    enum wheeled_mode mode;
    double target;
};

struct wheeled_axis {
    double angle, speed, torque; /* of the gear's output */
    double integral;             /* of the speed loop, N·m */
};

struct wheeled {
    struct wheeled_parameters parameters;
    double walls[4 * WHEELED_WALLS]; /* x, y of the ends of each */
    uint32_t wall_count;
    double others[2 * WHEELED_OTHERS]; /* x, y of each */
    uint32_t other_count;
    int64_t now_ns;
    double pose[3];     /* x m, y m, heading rad */
    double speed, rate; /* of the body: m/s ahead, rad/s */
    struct wheeled_axis axis[WHEELED_AXES];
    double slip[2];    /* m/s, of each wheel on the floor */
    uint32_t contacts; /* how often it has run into a wall or another robot */
    double impact;     /* m/s, the fastest of these */
    double least;      /* m, between body and the nearest of these, the least so far */
    bool touching;
    uint64_t stream; /* of random numbers */
};

/* False with the reason when parameters or walls, `count` of them, cannot be. */
bool wheeled_check(const struct wheeled_parameters *parameters, const double *walls, size_t count, char *why,
                   size_t size);

/* At rest at the initial pose. Parameters and walls have to pass wheeled_check(). */
void wheeled_begin(struct wheeled *robot, const struct wheeled_parameters *parameters, const double *walls,
                   size_t count);

/* Where another robot is from now on; false, and nothing happens, where there are WHEELED_OTHERS. */
bool wheeled_meet(struct wheeled *robot, double x, double y);

/* No other robot is there any more. */
void wheeled_part(struct wheeled *robot);

/* Let time pass with these demands; false, and nothing happens, where it is negative or too long. */
bool wheeled_advance(struct wheeled *robot, int64_t duration_ns, const struct wheeled_demand demand[WHEELED_AXES]);

/* What the encoder of an axis counts. */
int32_t wheeled_counts(const struct wheeled *robot, int axis);

/* Distance from body to the nearest wall or robot; negative inside one's reach, infinite where there are none. */
double wheeled_nearest(const struct wheeled *robot);

/* True range in one direction from the scanner, in m; infinite where there is nothing. */
double wheeled_cast(const struct wheeled *robot, double bearing);

/* A scan in mm as a URG-04LX tells it, with noise: 0 where nothing is measured. */
void wheeled_scan(struct wheeled *robot, uint16_t millimetres[WHEELED_STEPS]);

/* The same of some steps, from `first` up to but not with `end`, where the robot is now: a scanner turns. */
void wheeled_scan_part(struct wheeled *robot, int first, int end, uint16_t millimetres[WHEELED_STEPS]);

#endif
