/** pid
 *
 * A PID controller in parallel form, with limited output. The derivative is that of the measurement, so a step of the
 * set point gives no kick.
 *
 * Equations:
 *   T: time since the step before, in s
 *   e = set_point − measurement, the short way round where `turn` is set
 *   D = (filter·D + measurement − measurement before)/(filter + T)
 *   u = kp·e + I − kd·D + feed_forward,  out = min(max(u, min), max)
 *   I += ki·T·e, with anti-windup:
 *     clamping          not while u is beyond a limit and e would drive it further
 *     back-calculation  I += T/max(tracking, T)·(out − u) as well
 *   while reset is 1: I = 0, D = 0, out = 0 within the limits
 *
 * Failure: In a step with an input that is not finite, `out` is 0 within the limits, `saturated` is 0, the integral
 * stays, and the derivative begins again. A `min` above `max` is refused when the task is loaded.
 */
#include <flotilla/block.h>
#include <math.h>

enum anti_windup { CLAMPING, BACK_CALCULATION, NONE };
enum { SET_POINT, MEASUREMENT, FEED_FORWARD, RESET };
enum { OUT, SATURATED };

struct pid {
    double kp, ki, kd, filter, min, max, tracking, turn;
    int anti_windup;
};

/* The integral is stored multiplied by its gain and the derivative without, so that tuning ki or kd causes no jump. */
struct state {
    double integral;    /* part of the output */
    double derivative;  /* of the measurement, filtered */
    double measurement; /* that the derivative is of */
    int64_t since_ns;   /* that was, in time of the block's steps */
    bool begun;         /* there was a step before */
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct pid, kp, .flags = FL_TUNABLE, .default_value = "0", .summary = "gain of the error"),
    FL_PARAMETER(struct pid, ki, .flags = FL_TUNABLE, .default_value = "0", .unit = "1/s",
                 .summary = "gain of the error's integral"),
    FL_PARAMETER(struct pid, kd, .flags = FL_TUNABLE, .default_value = "0", .unit = "s",
                 .summary = "gain of the measurement's derivative, which is subtracted"),
    FL_PARAMETER(struct pid, filter, .flags = FL_TUNABLE, .default_value = "0", .max = INFINITY, .unit = "s",
                 .summary = "time constant of the derivative's low-pass filter; 0: none"),
    FL_PARAMETER(struct pid, min, .flags = FL_TUNABLE, .summary = "least output"),
    FL_PARAMETER(struct pid, max, .flags = FL_TUNABLE, .summary = "greatest output"),
    FL_PARAMETER(struct pid, anti_windup, .default_value = "clamping", .choices = "clamping|back-calculation|none",
                 .summary = "clamping: the integral waits while the output is limited and the error would drive it "
                            "further; back-calculation: it is led back within `tracking`"),
    FL_PARAMETER(struct pid, tracking, .default_value = "1", .min = 1e-6, .max = INFINITY, .unit = "s",
                 .summary = "time constant of back-calculation"),
    FL_PARAMETER(struct pid, turn, .default_value = "0", .max = INFINITY,
                 .summary = "for an angle: its full turn (360, 6.283185307179586), so that the error is the short way "
                            "round; 0: no angle"),
};

static const struct fl_port inputs[] = {
    {.name = "set_point", .type = FL_DOUBLE, .width = 1, .summary = "desired value of the measurement"},
    {.name = "measurement", .type = FL_DOUBLE, .width = 1, .summary = "what it is"},
    {.name = "feed_forward", .type = FL_DOUBLE, .width = 1, .flags = FL_OPTIONAL, .summary = "added to the output"},
    {.name = "reset",
     .type = FL_BOOLEAN,
     .width = 1,
     .flags = FL_OPTIONAL,
     .summary = "1: out is zero within the limits, and integral and derivative restart"},
};

static const struct fl_port outputs[] = {
    {.name = "out",
     .type = FL_DOUBLE,
     .width = 1,
     .summary = "the command; zero within the limits in a step with an input that is not finite"},
    {.name = "saturated", .type = FL_BOOLEAN, .width = 1, .summary = "1: out is at min or max"},
};

static double limited(const struct pid *pid, double value)
{
    return fmin(fmax(value, pid->min), pid->max);
}

static double difference(const struct pid *pid, double to, double from)
{
    return pid->turn > 0 ? remainder(to - from, pid->turn) : to - from;
}

static int configure(struct fl_block *block)
{
    const struct pid *pid = block->parameters;
    if (pid->min > pid->max)
        return fl_fail(block, "min %g is above max %g", pid->min, pid->max);
    return FL_OK;
}

static void rest(struct fl_block *block)
{
    FL_OUT(block, OUT, double) = limited(block->parameters, 0);
    FL_OUT(block, SATURATED, bool) = false;
}

static int initialize(struct fl_block *block)
{
    struct state *state = block->state;
    *state = (struct state){0};
    rest(block);
    return FL_OK;
}

static void integrate(const struct pid *pid, struct state *state, double h, double error, double wanted, double out)
{
    double growth = pid->ki * h * error;
    switch (pid->anti_windup) {
    case CLAMPING:
        if ((wanted > out && growth > 0) || (wanted < out && growth < 0))
            growth = 0;
        break;
    case BACK_CALCULATION:
        growth += h / fmax(pid->tracking, h) * (out - wanted);
        break;
    case NONE:
        break;
    }
    if (isfinite(state->integral + growth))
        state->integral += growth;
}

/* Two steps that a trigger brought close together would divide by almost zero, so the second one is left out. */
static void differentiate(const struct fl_block *block, double measurement)
{
    const struct pid *pid = block->parameters;
    struct state *state = block->state;
    state->since_ns += block->interval_ns;
    if (state->begun && 2 * state->since_ns < block->period_ns)
        return;
    double change = difference(pid, measurement, state->measurement);
    state->derivative =
        state->begun ? (pid->filter * state->derivative + change) / (pid->filter + 1e-9 * (double)state->since_ns) : 0;
    state->measurement = measurement;
    state->since_ns = 0;
}

static int step(struct fl_block *block)
{
    const struct pid *pid = block->parameters;
    struct state *state = block->state;
    double h = fl_interval_s(block), measurement = FL_IN(block, MEASUREMENT, double);
    double error = difference(pid, FL_IN(block, SET_POINT, double), measurement);
    if (FL_IN(block, RESET, uint8_t))
        return initialize(block);
    differentiate(block, measurement);
    double wanted =
        pid->kp * error + state->integral - pid->kd * state->derivative + FL_IN(block, FEED_FORWARD, double);
    state->begun = isfinite(wanted) && isfinite(state->derivative); /* otherwise the derivative starts again */
    if (!state->begun) {
        rest(block);
        return FL_OK;
    }
    double out = limited(pid, wanted);
    integrate(pid, state, h, error, wanted, out);
    FL_OUT(block, OUT, double) = out;
    FL_OUT(block, SATURATED, bool) = out < wanted || out > wanted;
    return FL_OK;
}

FL_BLOCK(pid) = {
    .abi = FL_ABI,
    .name = "pid",
    .summary = "PID controller: parallel form, derivative of the measurement, limited output",
    .source = "Åström, Murray, Feedback Systems, 2nd edition, section 11.5",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct pid),
    .state_size = sizeof(struct state),
    .configure = configure,
    .initialize = initialize,
    .step = step,
};
