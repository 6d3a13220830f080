/** logic
 *
 * Combines flags.
 *
 * Equations:
 *   n: how many of the N inputs are not 0
 *   and: n = N;  or: n > 0;  xor: n is odd;  not: n = 0
 *
 * Failure: Cannot fail.
 */
#include "ports.h"

#include <inttypes.h>

enum operation { AND, OR, XOR, NOT };

struct logic {
    int operation;
    int64_t inputs;
};

static const struct fl_parameter logic_parameters[] = {
    FL_PARAMETER(struct logic, operation, .default_value = "and", .choices = "and|or|xor|not",
                 .summary = "how; not: true when none of the inputs is"),
    FL_PARAMETER(struct logic, inputs, .default_value = "2", .min = 1, .max = 32, .summary = "how many"),
};

static const struct fl_port logic_outputs[] = {
    {.name = "out", .type = FL_BOOLEAN, .width = 1, .summary = "0 or 1"},
};

static int configure_logic(struct fl_block *block)
{
    const struct logic *logic = block->parameters;
    for (uint32_t i = 0; i < logic->inputs; i++) {
        struct fl_port port = {.name = port_numbered(block, "in", i), .type = FL_BOOLEAN, .width = 1};
        port.summary = "0, or anything else for true";
        if (!port.name || fl_add_input(block, port) != FL_OK)
            return FL_FAILED;
    }
    return FL_OK;
}

static int step_logic(struct fl_block *block)
{
    const struct logic *logic = block->parameters;
    uint32_t count = 0;
    for (uint32_t i = 0; i < block->in_count; i++)
        count += FL_IN(block, i, uint8_t) != 0;
    const bool results[] = {
        [AND] = count == block->in_count, [OR] = count != 0, [XOR] = count % 2 == 1, [NOT] = count == 0};
    FL_OUT(block, 0, bool) = results[logic->operation];
    return FL_OK;
}

FL_BLOCK(logic) = {
    .abi = FL_ABI,
    .name = "logic",
    .summary = "combines flags: inputs in0, in1, ...",
    .source = "Simulink's block Logical Operator",
    FL_TABLE(output, logic_outputs),
    FL_TABLE(parameter, logic_parameters),
    .parameters_size = sizeof(struct logic),
    .configure = configure_logic,
    .step = step_logic,
};

/** select
 *
 * Lets a flag choose between two signals. An input without a wire is 0, so it also switches one signal on and off.
 *
 * Equations:
 *   out = then, while condition is not 0; otherwise out = otherwise
 *
 * Failure: Cannot fail. Values that are not finite pass.
 */
static const struct fl_port select_inputs[] = {
    {.name = "condition", .type = FL_BOOLEAN, .width = 1, .summary = "which"},
    {.name = "then", .type = FL_DOUBLE, .width = 1, .flags = FL_OPTIONAL, .summary = "out while condition is true"},
    {.name = "otherwise",
     .type = FL_DOUBLE,
     .width = 1,
     .flags = FL_OPTIONAL,
     .summary = "out while condition is false"},
};

static const struct fl_port select_outputs[] = {
    {.name = "out", .type = FL_DOUBLE, .width = 1, .summary = "one of them; zero for one without a wire"},
};

static int step_select(struct fl_block *block)
{
    FL_OUT(block, 0, double) = FL_IN(block, 0, uint8_t) ? FL_IN(block, 1, double) : FL_IN(block, 2, double);
    return FL_OK;
}

FL_BLOCK(select) = {
    .abi = FL_ABI,
    .name = "select",
    .summary = "lets a flag choose between two signals, or between a signal and zero",
    .source = "Simulink's block Switch",
    FL_TABLE(input, select_inputs),
    FL_TABLE(output, select_outputs),
    .step = step_select,
};
