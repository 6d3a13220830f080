/** angles-to-quaternion
 *
 * Gives an orientation as a quaternion. The angles are those of a body that turns by `yaw` about z, then by `pitch`
 * about its own y, then by `roll` about its own x.
 *
 * Equations:
 *   with cr = cos(roll/2), sr = sin(roll/2), and so on:
 *   x = sr·cp·cy − cr·sp·sy,  y = cr·sp·cy + sr·cp·sy,  z = cr·cp·sy − sr·sp·cy,  w = cr·cp·cy + sr·sp·sy
 *
 * Failure: Cannot fail. An input that is not finite gives outputs that are not.
 */
/** quaternion-to-angles
 *
 * Gives the angles of a quaternion, as angles-to-quaternion has them. It need not have length 1.
 *
 * Equations:
 *   a = w − y,  b = x + z,  c = w + y,  d = z − x;  s = atan2(b, a),  t = atan2(d, c)
 *   pitch = 2·atan2(√(c² + d²), √(a² + b²)) − π/2,  roll = s − t,  yaw = s + t
 *   at a pitch of ±π/2 roll and yaw turn about the same axis: roll = 0, and yaw = 2·t or 2·s
 *
 * Failure: Cannot fail. A quaternion of zeros, or one that is not finite, gives outputs that are not.
 */
#include <flotilla/block.h>
#include <math.h>

enum { ROLL, PITCH, YAW, ANGLES };

static const struct fl_port angle_inputs[ANGLES] = {
    {.name = "roll", .type = FL_DOUBLE, .width = 1, .flags = FL_OPTIONAL, .unit = "rad", .summary = "about x"},
    {.name = "pitch", .type = FL_DOUBLE, .width = 1, .flags = FL_OPTIONAL, .unit = "rad", .summary = "about y"},
    {.name = "yaw", .type = FL_DOUBLE, .width = 1, .unit = "rad", .summary = "about z: a heading"},
};
static const struct fl_port angle_outputs[ANGLES] = {
    {.name = "roll", .type = FL_DOUBLE, .width = 1, .unit = "rad", .summary = "about x, from -π to π"},
    {.name = "pitch", .type = FL_DOUBLE, .width = 1, .unit = "rad", .summary = "about y, from -π/2 to π/2"},
    {.name = "yaw", .type = FL_DOUBLE, .width = 1, .unit = "rad", .summary = "about z, from -π to π: a heading"},
};
static const struct fl_port quaternion[] = {
    {.name = "quaternion", .type = FL_DOUBLE, .width = 4, .summary = "x, y, z, w, as ROS has them"},
};

static int step_to_quaternion(struct fl_block *block)
{
    double *out = block->out[0], cosine[ANGLES], sine[ANGLES];
    for (int i = 0; i < ANGLES; i++) {
        cosine[i] = cos(FL_IN(block, i, double) / 2);
        sine[i] = sin(FL_IN(block, i, double) / 2);
    }
    out[0] = sine[ROLL] * cosine[PITCH] * cosine[YAW] - cosine[ROLL] * sine[PITCH] * sine[YAW];
    out[1] = cosine[ROLL] * sine[PITCH] * cosine[YAW] + sine[ROLL] * cosine[PITCH] * sine[YAW];
    out[2] = cosine[ROLL] * cosine[PITCH] * sine[YAW] - sine[ROLL] * sine[PITCH] * cosine[YAW];
    out[3] = cosine[ROLL] * cosine[PITCH] * cosine[YAW] + sine[ROLL] * sine[PITCH] * sine[YAW];
    return FL_OK;
}

static int step_to_angles(struct fl_block *block)
{
    const double pi = 3.14159265358979323846, upright = 1e-14; /* of the length: less is rounding */
    const double *in = block->in[0];
    const double x = in[0], y = in[1], z = in[2], w = in[3];
    const double up = hypot(w + y, z - x), down = hypot(w - y, x + z), length = hypot(up, down);
    const double lost = length > 0 && isfinite(length) ? 0 : NAN;
    double sum = atan2(x + z, w - y), difference = atan2(z - x, w + y);
    if (down <= upright * length)
        sum = difference;
    else if (up <= upright * length)
        difference = sum;
    FL_OUT(block, ROLL, double) = lost + remainder(sum - difference, 2 * pi);
    FL_OUT(block, PITCH, double) = lost + 2 * atan2(up, down) - pi / 2;
    FL_OUT(block, YAW, double) = lost + remainder(sum + difference, 2 * pi);
    return FL_OK;
}

FL_BLOCK(angles_to_quaternion) = {
    .abi = FL_ABI,
    .name = "angles-to-quaternion",
    .summary = "an orientation by roll, pitch and yaw, or by a heading alone, as a quaternion",
    .source = "Diebel, Representing Attitude: Euler Angles, Unit Quaternions, and Rotation Vectors (2006); REP 103",
    FL_TABLE(input, angle_inputs),
    FL_TABLE(output, quaternion),
    .step = step_to_quaternion,
};

FL_BLOCK(quaternion_to_angles) = {
    .abi = FL_ABI,
    .name = "quaternion-to-angles",
    .summary = "roll, pitch and yaw of a quaternion",
    .source = "Bernardes and Viollet, Quaternion to Euler angles conversion, PLOS ONE 17(11), 2022; REP 103",
    FL_TABLE(input, quaternion),
    FL_TABLE(output, angle_outputs),
    .step = step_to_angles,
};
