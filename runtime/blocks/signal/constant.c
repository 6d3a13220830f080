/** constant
 *
 * Holds a signal at the value of a parameter.
 *
 * Equations:
 *   out[i] = value[i]
 *
 * Failure: An empty list is refused when the task is loaded.
 */
#include <flotilla/block.h>
#include <string.h>

struct constant {
    struct fl_doubles value;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct constant, value, .summary = "a number, or a list: as many elements has `out`"),
};

static int configure(struct fl_block *block)
{
    const struct constant *constant = block->parameters;
    if (!constant->value.count)
        return fl_fail(block, "value is an empty list");
    return fl_add_output(
        block, (struct fl_port){
                   .name = "out", .type = FL_DOUBLE, .width = (uint32_t)constant->value.count, .summary = "the value"});
}

static int initialize(struct fl_block *block)
{
    const struct constant *constant = block->parameters;
    memcpy(block->out[0], constant->value.value, constant->value.count * sizeof(double));
    return FL_OK;
}

static int step(struct fl_block *block)
{
    (void)block;
    return FL_OK;
}

FL_BLOCK(constant) = {
    .abi = FL_ABI,
    .name = "constant",
    .summary = "a signal that never changes: output `out`, as wide as the list",
    .source = "Simulink's block Constant",
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct constant),
    .configure = configure,
    .initialize = initialize,
    .step = step,
};
