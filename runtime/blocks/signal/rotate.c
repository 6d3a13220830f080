/** rotate
 *
 * Gives a vector of the plane in axes that are turned by an angle: a command in the world as one in the robot's axes,
 * or back.
 *
 * Equations:
 *   into:    x' =  cos(angle)·x + sin(angle)·y,  y' = −sin(angle)·x + cos(angle)·y
 *   out-of:  x' =  cos(angle)·x − sin(angle)·y,  y' =  sin(angle)·x + cos(angle)·y
 *
 * Failure: Cannot fail. An input that is not finite gives outputs that are not.
 */
#include <flotilla/block.h>
#include <math.h>

enum { X, Y, ANGLE };
enum direction { INTO, OUT_OF };

struct rotate {
    int direction;
    int unit;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct rotate, direction, .default_value = "into", .choices = "into|out-of",
                 .summary = "into: from fixed axes into those that are turned by `angle`, as a robot's; out-of: back"),
    FL_PARAMETER(struct rotate, unit, .default_value = "rad", .choices = "rad|deg", .summary = "of `angle`"),
};

static const struct fl_port inputs[] = {
    {.name = "x", .type = FL_DOUBLE, .width = 1, .summary = "of a vector"},
    {.name = "y", .type = FL_DOUBLE, .width = 1, .summary = "of a vector"},
    {.name = "angle",
     .type = FL_DOUBLE,
     .width = 1,
     .summary = "of the turned axes against the fixed ones, from x to y"},
};

static const struct fl_port outputs[] = {
    {.name = "x", .type = FL_DOUBLE, .width = 1, .summary = "of the same vector in the other axes"},
    {.name = "y", .type = FL_DOUBLE, .width = 1, .summary = "of the same vector in the other axes"},
};

static int step(struct fl_block *block)
{
    static const double radians[] = {1, 3.14159265358979323846 / 180};
    const struct rotate *rotate = block->parameters;
    double x = FL_IN(block, X, double), y = FL_IN(block, Y, double);
    double angle = FL_IN(block, ANGLE, double) * radians[rotate->unit];
    double cosine = cos(angle), sine = rotate->direction == OUT_OF ? sin(angle) : -sin(angle);
    FL_OUT(block, X, double) = cosine * x - sine * y;
    FL_OUT(block, Y, double) = sine * x + cosine * y;
    return FL_OK;
}

FL_BLOCK(rotate) = {
    .abi = FL_ABI,
    .name = "rotate",
    .summary = "a vector of the plane in other axes: a command of the world as one of the robot, or back",
    .source = "Craig, Introduction to Robotics, section 2.2",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct rotate),
    .step = step,
};
