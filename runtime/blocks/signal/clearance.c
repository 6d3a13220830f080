/** curve-clearance
 *
 * Computes how far a round robot can go on each of several curves before it touches what a laser scanner sees. The
 * robot is a disc around the middle of its axle. Only motion ahead is considered.
 *
 * Equations:
 *   b = first + i·increment,  px = x + range·cos(b),  py = range·sin(b);  point i of the scan, x ahead, y to the left
 *   straight on s = px − √(radius² − py²), where |py| < radius and px > 0
 *   R = 1/|curvature|;  q = py on a curve to the left, −py on one to the right;  d = √(px² + (q − R)²)
 *   on a curve s = R·(atan2(px, R − q) − acos((R² + d² − radius²)/(2·R·d))), plus 2π·R where that is negative
 *   clearance = min(s of all points, reach);  a point within the disc: s = 0 where px > 0, otherwise it is left behind
 *   a range of −∞ is something at the scanner, too near to be measured: s = 0 where x > 0 or cos(b) > 0
 *
 * Failure: A direction whose range is not a number, or is +∞, counts as free, as beyond the scanner's reach. While
 * fewer than `least_seen` of all directions have another range, or the input `flag` is 0, the output `flag` is 0, and
 * each clearance is 0.
 */
#include <flotilla/block.h>
#include <math.h>

#define TURN 6.28318530717958647693

struct clearance {
    int64_t points;
    double first, increment, x, radius, reach, least_seen;
    struct fl_doubles curvatures;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct clearance, points, .min = 1, .max = 4096, .summary = "directions of a scan"),
    FL_PARAMETER(struct clearance, first, .min = -7, .max = 7, .unit = "rad",
                 .summary = "direction of the first range; 0: ahead, anticlockwise positive"),
    FL_PARAMETER(struct clearance, increment, .min = -7, .max = 7, .unit = "rad", .summary = "from range to range"),
    FL_PARAMETER(struct clearance, x, .default_value = "0", .min = -10, .max = 10, .unit = "m",
                 .summary = "where the scanner is, ahead of the axle's middle"),
    FL_PARAMETER(struct clearance, radius, .min = 1e-3, .max = 100, .unit = "m", .summary = "of the robot"),
    FL_PARAMETER(struct clearance, reach, .default_value = "5", .min = 1e-3, .max = 1e3, .unit = "m",
                 .summary = "longest clearance that is told"),
    FL_PARAMETER(struct clearance, least_seen, .default_value = "0.3", .max = 1,
                 .summary = "share of the directions that a sound scan measures at least"),
    FL_PARAMETER(struct clearance, curvatures, .default_value = "0", .min = -1e3, .max = 1e3, .unit = "1/m",
                 .summary = "of the curves, increasing; positive: to the left"),
};

enum { RANGES, GOOD };
enum { CLEARANCE, FLAG };

static int configure(struct fl_block *block)
{
    const struct clearance *set = block->parameters;
    for (size_t i = 1; i < set->curvatures.count; i++)
        if (!(set->curvatures.value[i] > set->curvatures.value[i - 1]))
            return fl_fail(block, "curvatures: %g does not increase to %g", set->curvatures.value[i - 1],
                           set->curvatures.value[i]);
    int failed = fl_add_input(block, (struct fl_port){.name = "ranges",
                                                      .type = FL_DOUBLE,
                                                      .width = (uint32_t)set->points,
                                                      .unit = "m",
                                                      .summary = "of the scanner, in each direction"});
    failed |= fl_add_input(block, (struct fl_port){.name = "flag",
                                                   .type = FL_BOOLEAN,
                                                   .width = 1,
                                                   .summary = "of the scanner: 1: the ranges are good"});
    failed |= fl_add_output(block, (struct fl_port){.name = "clearance",
                                                    .type = FL_DOUBLE,
                                                    .width = (uint32_t)set->curvatures.count,
                                                    .unit = "m",
                                                    .summary = "path of the axle's middle, on each curve"});
    failed |= fl_add_output(
        block,
        (struct fl_port){.name = "flag", .type = FL_BOOLEAN, .width = 1, .summary = "1: the clearances are good"});
    return failed;
}

/* Path to where the disc touches the point; `reach` where it does not. */
static double path(const struct clearance *set, double curvature, double px, double py)
{
    double radius = set->radius;
    if (hypot(px, py) <= radius)
        return px > 0 ? 0 : set->reach;
    if (fabs(curvature) < 1e-9)
        return px > 0 && fabs(py) < radius ? px - sqrt(radius * radius - py * py) : set->reach;
    double bend = 1 / fabs(curvature), aside = curvature > 0 ? py : -py;
    double distance = hypot(px, aside - bend);
    double cosine = (bend * bend + distance * distance - radius * radius) / (2 * bend * distance);
    if (!(cosine >= -1 && cosine <= 1)) /* the point is never touched, or is the centre of the curve */
        return set->reach;
    double angle = atan2(px, bend - aside) - acos(cosine);
    return bend * (angle < 0 ? angle + TURN : angle);
}

static int initialize(struct fl_block *block)
{
    for (uint32_t i = 0; i < block->out_ports[CLEARANCE].width; i++)
        ((double *)block->out[CLEARANCE])[i] = 0;
    FL_OUT(block, FLAG, bool) = false;
    return FL_OK;
}

static int step(struct fl_block *block)
{
    const struct clearance *set = block->parameters;
    const double *ranges = block->in[RANGES];
    double *clearance = block->out[CLEARANCE];
    int64_t seen = 0;
    for (size_t i = 0; i < set->curvatures.count; i++)
        clearance[i] = set->reach;
    bool blocked = false;
    for (int64_t i = 0; i < set->points; i++) {
        double bearing = set->first + (double)i * set->increment;
        if (!(ranges[i] < (double)INFINITY))
            continue;
        if (!isfinite(ranges[i])) {
            seen++;
            blocked |= set->x > 0 || cos(bearing) > 0;
            continue;
        }
        double px = set->x + ranges[i] * cos(bearing), py = ranges[i] * sin(bearing);
        seen++;
        if (hypot(px, py) > set->reach + set->radius)
            continue; /* no path of that length touches it */
        for (size_t j = 0; j < set->curvatures.count; j++)
            clearance[j] = fmin(clearance[j], path(set, set->curvatures.value[j], px, py));
    }
    bool good = FL_IN(block, GOOD, uint8_t) && (double)seen >= set->least_seen * (double)set->points;
    for (size_t i = 0; (!good || blocked) && i < set->curvatures.count; i++)
        clearance[i] = 0;
    FL_OUT(block, FLAG, bool) = good;
    return FL_OK;
}

FL_BLOCK(curve_clearance) = {
    .abi = FL_ABI,
    .name = "curve-clearance",
    .summary = "how far a round robot can go on each of several curves, by a scan",
    .source = "Fox, Burgard, Thrun, The Dynamic Window Approach to Collision Avoidance, section 4.1",
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct clearance),
    .configure = configure,
    .initialize = initialize,
    .step = step,
};
