/** limit
 *
 * Keeps a signal within a range, and its change below a rate.
 *
 * Equations:
 *   c = rate·T, unlimited for a rate of 0;  T: time since the step before, in s
 *   out(k) = min(max(clamp(in, out(k − 1) − c, out(k − 1) + c), min), max),  out(−1) = initial
 *   limited = (out ≠ in)
 *
 * Failure: While the input is not a number, `out` keeps its value and `limited` is 1. A `min` above `max` is refused
 * when the task is loaded.
 */
#include <flotilla/block.h>
#include <math.h>

struct limit {
    double min, max, rate, initial;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct limit, min, .flags = FL_TUNABLE | FL_SAFETY, .summary = "least output"),
    FL_PARAMETER(struct limit, max, .flags = FL_TUNABLE | FL_SAFETY, .summary = "greatest output"),
    FL_PARAMETER(struct limit, rate, .flags = FL_TUNABLE | FL_SAFETY, .default_value = "0", .max = INFINITY,
                 .unit = "1/s", .summary = "fastest change of the output, either way; 0: any"),
    FL_PARAMETER(struct limit, initial, .default_value = "0",
                 .summary = "output at time zero, from where the first change is limited"),
};

static const struct fl_port inputs[] = {{.name = "in", .type = FL_DOUBLE, .width = 1, .summary = "any signal"}};

static const struct fl_port outputs[] = {
    {.name = "out", .type = FL_DOUBLE, .width = 1, .summary = "in, limited; while in is not a number, what it was"},
    {.name = "limited", .type = FL_BOOLEAN, .width = 1, .summary = "1: out is not in"},
};

static double clamped(const struct limit *limit, double value)
{
    return fmin(fmax(value, limit->min), limit->max);
}

static int configure(struct fl_block *block)
{
    const struct limit *limit = block->parameters;
    if (limit->min > limit->max)
        return fl_fail(block, "min %g is above max %g", limit->min, limit->max);
    return FL_OK;
}

static int initialize(struct fl_block *block)
{
    const struct limit *limit = block->parameters;
    FL_OUT(block, 0, double) = clamped(limit, limit->initial);
    return FL_OK;
}

static int step(struct fl_block *block)
{
    const struct limit *limit = block->parameters;
    double in = FL_IN(block, 0, double), before = FL_OUT(block, 0, double);
    double change = limit->rate > 0 ? limit->rate * 1e-9 * (double)block->interval_ns : INFINITY;
    /* The range has precedence over the rate: tuning may have moved a limit past the output. */
    double out = isnan(in) ? before : clamped(limit, fmin(fmax(in, before - change), before + change));
    FL_OUT(block, 0, double) = out;
    FL_OUT(block, 1, bool) = !(out == in);
    return FL_OK;
}

FL_BLOCK(limit) = {
    .abi = FL_ABI,
    .name = "limit",
    .summary = "keeps a signal in a range, and its change below a rate",
    .source = "Simulink's blocks Saturation and Rate Limiter",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct limit),
    .configure = configure,
    .initialize = initialize,
    .step = step,
};
