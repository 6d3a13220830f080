/** differential-drive
 *
 * Turns the commanded motion of a robot into the speeds of its two driven wheels on one axle.
 *
 * Equations:
 *   left  = s·(v − omega·track/2)/radius
 *   right = s·(v + omega·track/2)/radius
 *   s = fastest/max(|left|, |right|) where a wheel would be faster than `fastest`, otherwise 1
 *
 * Failure: When a command is not finite both wheels get 0, and `limited` is 1.
 */
#include <flotilla/block.h>
#include <math.h>

static const char source[] =
    "Siegwart, Nourbakhsh, Scaramuzza, Introduction to Autonomous Mobile Robots, chapters 3, 5";

struct drive {
    double radius, track, fastest;
};

static const struct fl_parameter drive_parameters[] = {
    FL_PARAMETER(struct drive, radius, .min = 1e-6, .max = 1e3, .unit = "m", .summary = "of the wheels"),
    FL_PARAMETER(struct drive, track, .min = 1e-6, .max = 1e3, .unit = "m", .summary = "from wheel to wheel"),
    FL_PARAMETER(struct drive, fastest, .default_value = "0", .max = INFINITY, .unit = "rad/s",
                 .summary = "of a wheel: faster commands are slowed on both, so that the curve stays; 0: no limit"),
};

static const struct fl_port drive_inputs[] = {
    {.name = "v", .type = FL_DOUBLE, .width = 1, .unit = "m/s", .summary = "speed of the axle's middle, ahead"},
    {.name = "omega", .type = FL_DOUBLE, .width = 1, .unit = "rad/s", .summary = "rate of turn, anticlockwise"},
};

static const struct fl_port drive_outputs[] = {
    {.name = "left", .type = FL_DOUBLE, .width = 1, .unit = "rad/s", .summary = "wheel; zero if v, omega not finite"},
    {.name = "right", .type = FL_DOUBLE, .width = 1, .unit = "rad/s", .summary = "wheel; zero if v, omega not finite"},
    {.name = "limited", .type = FL_BOOLEAN, .width = 1, .summary = "1: the wheels turn slower than commanded"},
};

static int step_drive(struct fl_block *block)
{
    const struct drive *drive = block->parameters;
    double v = FL_IN(block, 0, double), turn = FL_IN(block, 1, double) * drive->track / 2;
    double left = (v - turn) / drive->radius, right = (v + turn) / drive->radius;
    double faster = fmax(fabs(left), fabs(right)), slowed = 1;
    bool finite = isfinite(left) && isfinite(right);
    if (!finite)
        left = right = 0;
    else if (drive->fastest > 0 && faster > drive->fastest)
        slowed = drive->fastest / faster;
    FL_OUT(block, 0, double) = left * slowed;
    FL_OUT(block, 1, double) = right * slowed;
    FL_OUT(block, 2, bool) = !finite || slowed < 1;
    return FL_OK;
}

FL_BLOCK(differential_drive) = {
    .abi = FL_ABI,
    .name = "differential-drive",
    .summary = "speeds of two wheels that move a robot as commanded",
    .source = source,
    FL_TABLE(input, drive_inputs),
    FL_TABLE(output, drive_outputs),
    FL_TABLE(parameter, drive_parameters),
    .parameters_size = sizeof(struct drive),
    .step = step_drive,
};

/** differential-odometry
 *
 * Computes motion and pose of a robot from the speeds of its two driven wheels on one axle. It is exact while these
 * speeds are constant between two steps.
 *
 * Equations:
 *   v = radius·(right + left)/2,  omega = radius·(right − left)/track
 *   a = omega·T/2,  c = v·T·sin(a)/a;  T: time since the step before, in s
 *   x += c·cos(heading + a),  y += c·sin(heading + a),  heading += omega·T
 *
 * Failure: While a wheel's speed is not finite, `v` and `omega` are 0 and the pose stays.
 */
struct odometry {
    double radius, track, x, y, heading;
};

enum { LEFT, RIGHT, RESET };
enum { V, OMEGA, X, Y, HEADING };

static const struct fl_parameter odometry_parameters[] = {
    FL_PARAMETER(struct odometry, radius, .min = 1e-6, .max = 1e3, .unit = "m", .summary = "of the wheels"),
    FL_PARAMETER(struct odometry, track, .min = 1e-6, .max = 1e3, .unit = "m", .summary = "from wheel to wheel"),
    FL_PARAMETER(struct odometry, x, .default_value = "0", .unit = "m", .summary = "at time zero and after a reset"),
    FL_PARAMETER(struct odometry, y, .default_value = "0", .unit = "m", .summary = "at time zero and after a reset"),
    FL_PARAMETER(struct odometry, heading, .default_value = "0", .unit = "rad",
                 .summary = "at time zero and after a reset; from x to y"),
};

static const struct fl_port odometry_inputs[] = {
    {.name = "left", .type = FL_DOUBLE, .width = 1, .unit = "rad/s", .summary = "wheel, since the step before"},
    {.name = "right", .type = FL_DOUBLE, .width = 1, .unit = "rad/s", .summary = "wheel, since the step before"},
    {.name = "reset", .type = FL_BOOLEAN, .width = 1, .flags = FL_OPTIONAL, .summary = "1: back to the pose at start"},
};

static const struct fl_port odometry_outputs[] = {
    {.name = "v", .type = FL_DOUBLE, .width = 1, .unit = "m/s", .summary = "speed; zero if a wheel's is not finite"},
    {.name = "omega", .type = FL_DOUBLE, .width = 1, .unit = "rad/s", .summary = "rate of turn, anticlockwise"},
    {.name = "x", .type = FL_DOUBLE, .width = 1, .unit = "m", .summary = "of the axle's middle"},
    {.name = "y", .type = FL_DOUBLE, .width = 1, .unit = "m", .summary = "of the axle's middle"},
    {.name = "heading", .type = FL_DOUBLE, .width = 1, .unit = "rad", .summary = "beyond a full turn too"},
};

static int initialize_odometry(struct fl_block *block)
{
    const struct odometry *odometry = block->parameters;
    FL_OUT(block, V, double) = 0;
    FL_OUT(block, OMEGA, double) = 0;
    FL_OUT(block, X, double) = odometry->x;
    FL_OUT(block, Y, double) = odometry->y;
    FL_OUT(block, HEADING, double) = odometry->heading;
    return FL_OK;
}

static int step_odometry(struct fl_block *block)
{
    const struct odometry *odometry = block->parameters;
    double left = FL_IN(block, LEFT, double), right = FL_IN(block, RIGHT, double);
    double v = odometry->radius * (right + left) / 2, omega = odometry->radius * (right - left) / odometry->track;
    double h = fl_interval_s(block);
    if (FL_IN(block, RESET, uint8_t))
        return initialize_odometry(block);
    if (!isfinite(v) || !isfinite(omega))
        v = omega = 0;
    /* An arc's chord is its length times sin(a)/a of half its angle, and points halfway between the two headings:
     * exact while the wheels' speeds are constant between two steps. */
    double half = omega * h / 2, chord = v * h * (half < -1e-8 || half > 1e-8 ? sin(half) / half : 1);
    double middle = FL_OUT(block, HEADING, double) + half;
    FL_OUT(block, V, double) = v;
    FL_OUT(block, OMEGA, double) = omega;
    FL_OUT(block, X, double) += chord * cos(middle);
    FL_OUT(block, Y, double) += chord * sin(middle);
    FL_OUT(block, HEADING, double) += omega * h;
    return FL_OK;
}

FL_BLOCK(differential_odometry) = {
    .abi = FL_ABI,
    .name = "differential-odometry",
    .summary = "motion and pose of a robot from the speeds of its two wheels",
    .source = source,
    FL_TABLE(input, odometry_inputs),
    FL_TABLE(output, odometry_outputs),
    FL_TABLE(parameter, odometry_parameters),
    .parameters_size = sizeof(struct odometry),
    .initialize = initialize_odometry,
    .step = step_odometry,
};
