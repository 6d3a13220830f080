/** join
 *
 * Makes one wide signal of several of the same type.
 *
 * Equations:
 *   out[i] = in_i
 *
 * Failure: Cannot fail. Values that are not finite pass.
 */
#include "ports.h"

#include <string.h>

struct join {
    int type; /* enum fl_type */
    int64_t inputs;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct join, type, .default_value = "double", .choices = TYPE_CHOICES, .summary = "of the signals"),
    FL_PARAMETER(struct join, inputs, .default_value = "2", .min = 1, .max = 64, .summary = "how many"),
};

static int configure(struct fl_block *block)
{
    const struct join *join = block->parameters;
    enum fl_type type = (enum fl_type)join->type;
    for (uint32_t i = 0; i < join->inputs; i++) {
        struct fl_port port = {.name = port_numbered(block, "in", i), .type = type, .width = 1};
        port.summary = "an element of out";
        if (!port.name || fl_add_input(block, port) != FL_OK)
            return FL_FAILED;
    }
    return fl_add_output(
        block,
        (struct fl_port){.name = "out", .type = type, .width = (uint32_t)join->inputs, .summary = "in0, in1, ..."});
}

static int step(struct fl_block *block)
{
    const struct join *join = block->parameters;
    size_t size = fl_type_size((enum fl_type)join->type);
    for (uint32_t i = 0; i < block->in_count; i++)
        memcpy((char *)block->out[0] + i * size, block->in[i], size);
    return FL_OK;
}

FL_BLOCK(join) = {
    .abi = FL_ABI,
    .name = "join",
    .summary = "makes one wide signal of several: inputs in0, in1, ..., output `out`",
    .source = "Simulink's block Mux",
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct join),
    .configure = configure,
    .step = step,
};
