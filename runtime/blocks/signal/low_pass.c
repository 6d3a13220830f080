/** low-pass
 *
 * Smooths a signal by a first-order low-pass filter. It is exact for an input that is constant between two steps.
 *
 * Equations:
 *   out(k) = in + (out(k − 1) − in)·exp(−T/time_constant);  T: time since the step before, in s
 *   out = in for the first finite value, and always for a time constant of 0
 *
 * Failure: While the input is not finite, `out` keeps its value.
 */
#include <flotilla/block.h>
#include <math.h>

struct low_pass {
    double time_constant;
};

struct state {
    double value;
    bool begun;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct low_pass, time_constant, .flags = FL_TUNABLE, .max = INFINITY, .unit = "s",
                 .summary = "time after which the output has followed 63 % of a step; 0: no filter"),
};

static const struct fl_port inputs[] = {{.name = "in", .type = FL_DOUBLE, .width = 1, .summary = "any signal"}};

static const struct fl_port outputs[] = {
    {.name = "out", .type = FL_DOUBLE, .width = 1, .summary = "in, smoothed; begins at the first number of in"},
};

static int initialize(struct fl_block *block)
{
    struct state *state = block->state;
    *state = (struct state){0};
    FL_OUT(block, 0, double) = 0;
    return FL_OK;
}

static int step(struct fl_block *block)
{
    const struct low_pass *low_pass = block->parameters;
    struct state *state = block->state;
    double in = FL_IN(block, 0, double);
    /* One value that is not finite would stay in the filter for ever. */
    if (!isfinite(in))
        return FL_OK;
    double rest = low_pass->time_constant > 0 ? exp(-fl_interval_s(block) / low_pass->time_constant) : 0;
    state->value = state->begun ? in + (state->value - in) * rest : in;
    state->begun = true;
    FL_OUT(block, 0, double) = state->value;
    return FL_OK;
}

FL_BLOCK(low_pass) = {
    .abi = FL_ABI,
    .name = "low-pass",
    .summary = "smooths a signal: first-order low-pass filter, exact for an input that is constant between two steps",
    .source = "zero-order-hold equivalent of 1/(Ts + 1): Åström, Wittenmark, Computer-Controlled Systems, section 2.3",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct low_pass),
    .state_size = sizeof(struct state),
    .initialize = initialize,
    .step = step,
};
