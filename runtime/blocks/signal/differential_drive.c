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

#define ODOMETRY_PARAMETERS(type)                                                                                      \
    FL_PARAMETER(type, radius, .min = 1e-6, .max = 1e3, .unit = "m", .summary = "of the wheels"),                      \
        FL_PARAMETER(type, track, .min = 1e-6, .max = 1e3, .unit = "m", .summary = "from wheel to wheel"),             \
        FL_PARAMETER(type, x, .default_value = "0", .unit = "m", .summary = "at time zero and after a reset"),         \
        FL_PARAMETER(type, y, .default_value = "0", .unit = "m", .summary = "at time zero and after a reset"),         \
        FL_PARAMETER(type, heading, .default_value = "0", .unit = "rad",                                               \
                     .summary = "at time zero and after a reset; from x to y")

static const struct fl_parameter odometry_parameters[] = {ODOMETRY_PARAMETERS(struct odometry)};

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

static void place(struct fl_block *block, double x, double y, double heading)
{
    FL_OUT(block, V, double) = 0;
    FL_OUT(block, OMEGA, double) = 0;
    FL_OUT(block, X, double) = x;
    FL_OUT(block, Y, double) = y;
    FL_OUT(block, HEADING, double) = heading;
}

static int initialize_odometry(struct fl_block *block)
{
    const struct odometry *odometry = block->parameters;
    place(block, odometry->x, odometry->y, odometry->heading);
    return FL_OK;
}

/* An arc's chord is its length times sin(a)/a of half its angle, and points halfway between the two headings: exact
 * while the wheels' speeds are constant between two steps. */
static void roll(struct fl_block *block, double v, double omega, double h)
{
    double half = omega * h / 2, chord = v * h * (half < -1e-8 || half > 1e-8 ? sin(half) / half : 1);
    double middle = FL_OUT(block, HEADING, double) + half;
    FL_OUT(block, V, double) = v;
    FL_OUT(block, OMEGA, double) = omega;
    FL_OUT(block, X, double) += chord * cos(middle);
    FL_OUT(block, Y, double) += chord * sin(middle);
    FL_OUT(block, HEADING, double) += omega * h;
}

static int step_odometry(struct fl_block *block)
{
    const struct odometry *odometry = block->parameters;
    double left = FL_IN(block, LEFT, double), right = FL_IN(block, RIGHT, double);
    double v = odometry->radius * (right + left) / 2, omega = odometry->radius * (right - left) / odometry->track;
    if (FL_IN(block, RESET, uint8_t))
        return initialize_odometry(block);
    if (!isfinite(v) || !isfinite(omega))
        v = omega = 0;
    roll(block, v, omega, fl_interval_s(block));
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

/** encoder-odometry
 *
 * Computes motion and pose of a robot from the angles of its two driven wheels on one axle, so that no motion is lost
 * between two steps. The first good angles are where it begins.
 *
 * A step takes the angles when both are new by their sequences, so a drive whose answer comes a step late does not look
 * as if it stood still, and then ran twice as fast. Until then `v` and `omega` stay the last ones, and the pose waits
 * for the angles that have the motion. Without the sequences angles are new in each step. Where answers begin to stay a
 * step late, or one is lost for good, the speeds of one step are wrong by up to a factor of two.
 *
 * Equations:
 *   wheels' speeds: what the angles changed by since the last step that took them, in the time since then
 *   all else as differential-odometry
 *
 * Failure: While the flag is 0, or an angle is not finite, `v` and `omega` are 0 and the pose stays; the next good
 * angles are a new beginning. Angles that changed faster than `fastest` are one, too: an encoder that counts from zero
 * again. `lost` counts such beginnings, each of which may have lost motion.
 */
struct encoders {
    double radius, track, x, y, heading, fastest;
};

struct angles {
    double left, right;
    uint32_t left_sequence, right_sequence;
    double since; /* s, from the step that took them */
    bool known, begun;
};

static const struct fl_parameter encoder_parameters[] = {
    ODOMETRY_PARAMETERS(struct encoders),
    FL_PARAMETER(struct encoders, fastest, .min = 1e-3, .max = 1e6, .unit = "rad/s",
                 .summary = "that a wheel can turn: a faster change of its angle is none of the robot's motion"),
};

enum { GOOD = RESET, ENCODER_RESET, LEFT_SEQUENCE, RIGHT_SEQUENCE };
static const struct fl_port encoder_inputs[] = {
    {.name = "left", .type = FL_DOUBLE, .width = 1, .unit = "rad", .summary = "angle of the wheel"},
    {.name = "right", .type = FL_DOUBLE, .width = 1, .unit = "rad", .summary = "angle of the wheel"},
    {.name = "flag", .type = FL_BOOLEAN, .width = 1, .summary = "1: both angles are good"},
    {.name = "reset", .type = FL_BOOLEAN, .width = 1, .flags = FL_OPTIONAL, .summary = "1: back to the pose at start"},
    {.name = "left_sequence",
     .type = FL_UINT32,
     .width = 1,
     .flags = FL_OPTIONAL,
     .summary = "changes with each measurement of the angle"},
    {.name = "right_sequence", .type = FL_UINT32, .width = 1, .flags = FL_OPTIONAL, .summary = "likewise"},
};

enum { LOST = HEADING + 1 };
static const struct fl_port encoder_outputs[] = {
    {.name = "v", .type = FL_DOUBLE, .width = 1, .unit = "m/s", .summary = "speed; zero where it is not known"},
    {.name = "omega", .type = FL_DOUBLE, .width = 1, .unit = "rad/s", .summary = "rate of turn, anticlockwise"},
    {.name = "x", .type = FL_DOUBLE, .width = 1, .unit = "m", .summary = "of the axle's middle"},
    {.name = "y", .type = FL_DOUBLE, .width = 1, .unit = "m", .summary = "of the axle's middle"},
    {.name = "heading", .type = FL_DOUBLE, .width = 1, .unit = "rad", .summary = "beyond a full turn too"},
    {.name = "lost", .type = FL_UINT32, .width = 1, .summary = "beginnings after the first one"},
};

static int initialize_encoders(struct fl_block *block)
{
    const struct encoders *set = block->parameters;
    struct angles *angles = block->state;
    place(block, set->x, set->y, set->heading);
    angles->known = false;
    return FL_OK;
}

static bool is_new(const struct fl_block *block, uint32_t input, uint32_t before)
{
    return !fl_wired(block, input) || FL_IN(block, input, uint32_t) != before;
}

/* Both angles were measured again, and time has passed. */
static bool come(const struct fl_block *block, const struct angles *before)
{
    return before->since > 0 && is_new(block, LEFT_SEQUENCE, before->left_sequence) &&
           is_new(block, RIGHT_SEQUENCE, before->right_sequence);
}

/* Begin at these angles. */
static void begin(const struct fl_block *block, struct angles *angles)
{
    *angles = (struct angles){.left = FL_IN(block, LEFT, double),
                              .right = FL_IN(block, RIGHT, double),
                              .left_sequence = FL_IN(block, LEFT_SEQUENCE, uint32_t),
                              .right_sequence = FL_IN(block, RIGHT_SEQUENCE, uint32_t),
                              .known = true,
                              .begun = true};
}

static int step_encoders(struct fl_block *block)
{
    const struct encoders *set = block->parameters;
    struct angles *angles = block->state, before = *angles;
    double left = FL_IN(block, LEFT, double) - before.left, right = FL_IN(block, RIGHT, double) - before.right;
    double h = before.since = angles->since += fl_interval_s(block);
    bool good = FL_IN(block, GOOD, uint8_t) && isfinite(left) && isfinite(right);
    bool taken = good && (!before.known || come(block, &before));
    bool moved = taken && before.known && fmax(fabs(left), fabs(right)) <= set->fastest * h;
    if (taken && before.begun && !moved)
        FL_OUT(block, LOST, uint32_t)++;
    if (taken)
        begin(block, angles);
    else if (!good)
        angles->known = false;
    if (FL_IN(block, ENCODER_RESET, uint8_t))
        place(block, set->x, set->y, set->heading);
    else if (moved)
        roll(block, set->radius * (right + left) / (2 * h), set->radius * (right - left) / (set->track * h), h);
    else if (taken || !good)
        roll(block, 0, 0, 0);
    return FL_OK;
}

FL_BLOCK(encoder_odometry) = {
    .abi = FL_ABI,
    .name = "encoder-odometry",
    .summary = "motion and pose of a robot from the angles of its two wheels",
    .source = source,
    FL_TABLE(input, encoder_inputs),
    FL_TABLE(output, encoder_outputs),
    FL_TABLE(parameter, encoder_parameters),
    .parameters_size = sizeof(struct encoders),
    .state_size = sizeof(struct angles),
    .initialize = initialize_encoders,
    .step = step_encoders,
};
