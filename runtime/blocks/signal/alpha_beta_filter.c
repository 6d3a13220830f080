/** alpha-beta-filter
 *
 * Estimates value and rate of a moving quantity from noisy measurements, each element by itself. Between two
 * measurements it predicts from the rate and from the acceleration, where that is known.
 *
 * Equations:
 *   T: time since the step before, in s; P: time since the last measurement that was taken, in s
 *   every step:         value += rate·T + acceleration·T²/2,  rate += acceleration·T
 *   a new measurement:  r = measurement − value,  value += α·r,  rate += β·r/P
 *   θ = exp(−P/time_constant),  α = 1 − θ²,  β = (1 − θ)²;  for the first measurement α = 1, β = 0
 *
 * Failure: A measurement is taken only when `sequence` has changed and all of its elements are finite; otherwise the
 * block goes on predicting. An acceleration that is not finite counts as zero. Go by the sensor's flag, this block has
 * none.
 */
#include <flotilla/block.h>
#include <math.h>

enum { MEASUREMENT, SEQUENCE, ACCELERATION };
enum { VALUE, RATE };

struct alpha_beta_filter {
    double time_constant;
    int64_t width;
};

struct state {
    bool begun;
    uint32_t sequence; /* of the last measurement taken */
    int64_t since_ns;  /* it was taken, in time of the block's steps */
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct alpha_beta_filter, time_constant, .flags = FL_TUNABLE, .min = 1e-6, .max = INFINITY,
                 .unit = "s",
                 .summary = "time constant of forgetting older measurements: longer is smoother and slower"),
    FL_PARAMETER(struct alpha_beta_filter, width, .default_value = "1", .min = 1, .max = 64,
                 .summary = "elements of the measurement"),
};

static int configure(struct fl_block *block)
{
    const struct alpha_beta_filter *set = block->parameters;
    const uint32_t width = (uint32_t)set->width;
    const struct fl_port in[] = {
        {.name = "measurement", .type = FL_DOUBLE, .width = width, .summary = "what moves"},
        {.name = "sequence",
         .type = FL_UINT32,
         .width = 1,
         .summary = "changes with each new measurement, as a sensor's"},
        {.name = "acceleration",
         .type = FL_DOUBLE,
         .width = width,
         .unit = "1/s²",
         .flags = FL_OPTIONAL,
         .summary = "that is known, as of forces that were commanded"},
    };
    const struct fl_port out[] = {
        {.name = "value",
         .type = FL_DOUBLE,
         .width = width,
         .summary = "of the measurement, now; zero before the first"},
        {.name = "rate", .type = FL_DOUBLE, .width = width, .unit = "1/s", .summary = "its change"},
    };
    for (size_t i = 0; i < sizeof in / sizeof in[0]; i++)
        if (fl_add_input(block, in[i]) != FL_OK)
            return FL_FAILED;
    for (size_t i = 0; i < sizeof out / sizeof out[0]; i++)
        if (fl_add_output(block, out[i]) != FL_OK)
            return FL_FAILED;
    return FL_OK;
}

static int initialize(struct fl_block *block)
{
    struct state *state = block->state;
    const struct alpha_beta_filter *set = block->parameters;
    *state = (struct state){0};
    for (int64_t i = 0; i < set->width; i++)
        ((double *)block->out[VALUE])[i] = ((double *)block->out[RATE])[i] = 0;
    return FL_OK;
}

/* A new measurement that can be used: all of it is finite. */
static bool measured(const struct fl_block *block, const struct state *state)
{
    const struct alpha_beta_filter *set = block->parameters;
    if (FL_IN(block, SEQUENCE, uint32_t) == state->sequence)
        return false;
    for (int64_t i = 0; i < set->width; i++)
        if (!isfinite(((const double *)block->in[MEASUREMENT])[i]))
            return false;
    return true;
}

static int step(struct fl_block *block)
{
    const struct alpha_beta_filter *set = block->parameters;
    struct state *state = block->state;
    const double *measurement = block->in[MEASUREMENT], *acceleration = block->in[ACCELERATION];
    double *value = block->out[VALUE], *rate = block->out[RATE];
    const double step_s = fl_interval_s(block);
    state->since_ns += block->interval_ns;
    for (int64_t i = 0; i < set->width; i++) {
        double change = isfinite(acceleration[i]) ? acceleration[i] * step_s : 0;
        value[i] += (rate[i] + change / 2) * step_s;
        rate[i] += change;
    }
    if (!measured(block, state) || !state->since_ns)
        return FL_OK;
    /* Critically damped: the gains of a line fitted by least squares to all measurements, older ones counting less. */
    double interval = 1e-9 * (double)block->period_ns * ((double)state->since_ns / (double)block->period_ns);
    double fade = exp(-interval / set->time_constant);
    double alpha = state->begun ? 1 - fade * fade : 1;
    double beta = state->begun ? (1 - fade) * (1 - fade) : 0;
    for (int64_t i = 0; i < set->width; i++) {
        double residual = measurement[i] - value[i];
        value[i] += alpha * residual;
        rate[i] += beta * residual / interval;
    }
    state->begun = true;
    state->sequence = FL_IN(block, SEQUENCE, uint32_t);
    state->since_ns = 0;
    return FL_OK;
}

FL_BLOCK(alpha_beta_filter) = {
    .abi = FL_ABI,
    .name = "alpha-beta-filter",
    .summary = "estimates value and rate from noisy measurements: inputs measurement, sequence; outputs value, rate",
    .source = "Brookner, Tracking and Kalman Filtering Made Easy, section 1.3: the critically damped g-h filter",
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct alpha_beta_filter),
    .state_size = sizeof(struct state),
    .configure = configure,
    .initialize = initialize,
    .step = step,
};
