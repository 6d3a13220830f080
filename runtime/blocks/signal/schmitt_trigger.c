/** schmitt-trigger
 *
 * Switches with hysteresis: on at one value, off below a lesser one.
 *
 * Equations:
 *   sign = 1 once in ≥ on, until in < off
 *   symmetric: also sign = −1 once −in ≥ on, until −in < off
 *   on = (sign ≠ 0)
 *
 * Failure: While the input is not a number, it is off. An `off` above `on` is refused when the task is loaded.
 */
#include <flotilla/block.h>

struct schmitt_trigger {
    double on, off;
    bool symmetric;
};

struct state {
    int sign; /* 1: on, -1: on below zero (symmetric only), 0: off */
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct schmitt_trigger, on, .flags = FL_TUNABLE, .summary = "goes on at this value and above"),
    FL_PARAMETER(struct schmitt_trigger, off, .flags = FL_TUNABLE, .summary = "goes off below this value"),
    FL_PARAMETER(struct schmitt_trigger, symmetric, .default_value = "false",
                 .summary = "the same below zero, mirrored: a dead band around zero, for an error with a sign"),
};

static const struct fl_port inputs[] = {
    {.name = "in", .type = FL_DOUBLE, .width = 1, .summary = "any signal; off while it is not a number"},
};

static const struct fl_port outputs[] = {
    {.name = "on", .type = FL_BOOLEAN, .width = 1, .summary = "1: on"},
    {.name = "sign", .type = FL_DOUBLE, .width = 1, .summary = "1: on, -1: on below zero, 0: off"},
};

static int configure(struct fl_block *block)
{
    const struct schmitt_trigger *trigger = block->parameters;
    if (trigger->off > trigger->on)
        return fl_fail(block, "off %g is above on %g", trigger->off, trigger->on);
    if (trigger->symmetric && (trigger->off < 0 || trigger->on <= 0))
        return fl_fail(block, "symmetric needs on above zero and off not below it");
    return FL_OK;
}

static int initialize(struct fl_block *block)
{
    struct state *state = block->state;
    state->sign = 0;
    FL_OUT(block, 0, bool) = false;
    FL_OUT(block, 1, double) = 0;
    return FL_OK;
}

static int step(struct fl_block *block)
{
    const struct schmitt_trigger *trigger = block->parameters;
    struct state *state = block->state;
    double in = FL_IN(block, 0, double);
    bool stays = state->sign && state->sign * in >= trigger->off;
    if (!stays) /* also straight from one side to the other */
        state->sign = in >= trigger->on ? 1 : trigger->symmetric && -in >= trigger->on ? -1 : 0;
    FL_OUT(block, 0, bool) = state->sign != 0;
    FL_OUT(block, 1, double) = state->sign;
    return FL_OK;
}

FL_BLOCK(schmitt_trigger) = {
    .abi = FL_ABI,
    .name = "schmitt-trigger",
    .summary = "switches with hysteresis: on at one value, off below a lesser one",
    .source = "Simulink's block Relay; O. H. Schmitt, A thermionic trigger, J. Sci. Instrum. 15 (1938)",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct schmitt_trigger),
    .state_size = sizeof(struct state),
    .configure = configure,
    .initialize = initialize,
    .step = step,
};
