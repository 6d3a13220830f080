/** gain
 *
 * Multiplies a signal by a constant.
 *
 * Equations:
 *   out = factor·in
 *
 * Failure: Cannot fail. An input that is not finite gives an output that is not.
 */
#include <flotilla/block.h>

struct gain {
    double factor;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct gain, factor, .flags = FL_TUNABLE, .default_value = "1",
                 .summary = "what the input is multiplied by"),
};

static const struct fl_port inputs[] = {{.name = "in", .type = FL_DOUBLE, .width = 1, .summary = "any signal"}};
static const struct fl_port outputs[] = {{.name = "out", .type = FL_DOUBLE, .width = 1, .summary = "factor * in"}};

static int step(struct fl_block *block)
{
    const struct gain *gain = block->parameters;
    FL_OUT(block, 0, double) = gain->factor * FL_IN(block, 0, double);
    return FL_OK;
}

FL_BLOCK(gain) = {
    .abi = FL_ABI,
    .name = "gain",
    .summary = "multiplies a signal by a constant",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct gain),
    .step = step,
};
