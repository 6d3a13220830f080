/** sum
 *
 * Adds and subtracts signals.
 *
 * Equations:
 *   out = ± in0 ± in1 …, by `signs`
 *
 * Failure: Cannot fail. An input that is not finite gives an output that is not. A text with anything but + and - is
 * refused when the task is loaded.
 */
#include "ports.h"

#include <string.h>

enum { MOST = 32 };

struct sum {
    const char *signs;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct sum, signs, .default_value = "++",
                 .summary = "one + or - for each input: \"+-\" gives out = in0 - in1"),
};

static const struct fl_port outputs[] = {
    {.name = "out", .type = FL_DOUBLE, .width = 1, .summary = "the inputs, each with its sign, in total"},
};

static int configure(struct fl_block *block)
{
    const struct sum *sum = block->parameters;
    size_t count = strlen(sum->signs);
    if (!count || count > MOST || strspn(sum->signs, "+-") != count)
        return fl_fail(block, "signs: \"%s\" is not 1 to %d of + and -", sum->signs, MOST);
    for (uint32_t i = 0; i < count; i++) {
        struct fl_port port = {.name = port_numbered(block, "in", i), .type = FL_DOUBLE, .width = 1};
        port.summary = sum->signs[i] == '+' ? "is added" : "is subtracted";
        if (!port.name || fl_add_input(block, port) != FL_OK)
            return FL_FAILED;
    }
    return FL_OK;
}

static int step(struct fl_block *block)
{
    const struct sum *sum = block->parameters;
    double total = 0;
    for (uint32_t i = 0; i < block->in_count; i++)
        total += sum->signs[i] == '+' ? FL_IN(block, i, double) : -FL_IN(block, i, double);
    FL_OUT(block, 0, double) = total;
    return FL_OK;
}

FL_BLOCK(sum) = {
    .abi = FL_ABI,
    .name = "sum",
    .summary = "adds and subtracts: an input in0, in1, ... for each sign",
    .source = "Simulink's block Sum",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct sum),
    .configure = configure,
    .step = step,
};
