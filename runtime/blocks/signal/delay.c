/** delay
 *
 * Outputs the value that its input had a step before, for a signal of any type, so this block may close a loop of
 * wires.
 *
 * Equations:
 *   out(k) = in(k − 1),  out(0) = initial
 *
 * Failure: A value of `initial` that the type cannot hold is refused when the task is loaded. Values that are not
 * finite pass.
 */
#include "ports.h"

#include <float.h>
#include <flotilla/block.h>
#include <math.h>
#include <string.h>

struct delay {
    int type; /* enum fl_type */
    int64_t width;
    double initial;
};

static const struct fl_parameter delay_parameters[] = {
    FL_PARAMETER(struct delay, type, .default_value = "double", .choices = TYPE_CHOICES, .summary = "of the signal"),
    FL_PARAMETER(struct delay, width, .default_value = "1", .min = 1, .max = 65536,
                 .summary = "elements of the signal"),
    FL_PARAMETER(struct delay, initial, .default_value = "0", .summary = "each element of `out` in the first step"),
};

/* The value as an element of that type; false where it does not fit. */
static bool make_element(int type, double value, void *element)
{
    static const struct {
        double min, beyond; /* a power of two, so that it has no rounding */
    } ranges[] = {
        [FL_BOOLEAN] = {0, 2},          [FL_INT8] = {-0x1p7, 0x1p7},    [FL_UINT8] = {0, 0x1p8},
        [FL_INT16] = {-0x1p15, 0x1p15}, [FL_UINT16] = {0, 0x1p16},      [FL_INT32] = {-0x1p31, 0x1p31},
        [FL_UINT32] = {0, 0x1p32},      [FL_INT64] = {-0x1p63, 0x1p63}, [FL_UINT64] = {0, 0x1p64},
    };
    if (type == FL_DOUBLE) {
        memcpy(element, &value, sizeof value);
        return true;
    }
    if (type == FL_SINGLE) {
        if (fabs(value) > (double)FLT_MAX)
            return false;
        memcpy(element, &(float){(float)value}, sizeof(float));
        return true;
    }
    if (value != floor(value) || value < ranges[type].min || value >= ranges[type].beyond)
        return false;
    /* Two's complement of any size is the lowest bytes of the longest. */
    uint64_t bits = value < 0 ? (uint64_t)(int64_t)value : (uint64_t)value;
    uint8_t *bytes = element;
    size_t size = fl_type_size((enum fl_type)type);
    const bool big_endian = *(const uint8_t *)&(const uint16_t){1} == 0;
    for (size_t i = 0; i < size; i++)
        bytes[big_endian ? size - 1 - i : i] = (uint8_t)(bits >> 8 * i);
    return true;
}

static int configure_delay(struct fl_block *block)
{
    const struct delay *delay = block->parameters;
    uint64_t element;
    enum fl_type type = (enum fl_type)delay->type;
    if (!make_element(delay->type, delay->initial, &element))
        return fl_fail(block, "initial: %g does not fit %s", delay->initial, fl_type_name(type));
    struct fl_port port = {.name = "in", .type = type, .width = (uint32_t)delay->width, .flags = FL_DELAYED};
    port.summary = "any signal";
    if (fl_add_input(block, port) != FL_OK)
        return FL_FAILED;
    port.name = "out";
    port.flags = 0;
    port.summary = "in, as it was a step before";
    return fl_add_output(block, port);
}

static int initialize_delay(struct fl_block *block)
{
    const struct delay *delay = block->parameters;
    size_t size = fl_type_size((enum fl_type)delay->type);
    for (size_t i = 0; i < (size_t)delay->width; i++)
        make_element(delay->type, delay->initial, (uint8_t *)block->out[0] + i * size);
    return FL_OK;
}

static int step_delay(struct fl_block *block)
{
    const struct delay *delay = block->parameters;
    if (block->step)
        memcpy(block->out[0], block->in[0], fl_type_size((enum fl_type)delay->type) * (size_t)delay->width);
    return FL_OK;
}

FL_BLOCK(delay) = {
    .abi = FL_ABI,
    .name = "delay",
    .summary = "gives the value of the step before, from input `in` to output `out`: lets wires form a loop",
    .source = "Simulink's block Unit Delay",
    FL_TABLE(parameter, delay_parameters),
    .parameters_size = sizeof(struct delay),
    .configure = configure_delay,
    .initialize = initialize_delay,
    .step = step_delay,
};

/** integrator
 *
 * Integrates a signal over time by the forward Euler method. Its input is delayed by a step, so it may close a loop of
 * wires.
 *
 * Equations:
 *   out(k) = out(k − 1) + T·in(k − 1),  out(0) = initial;  T: time since the step before, in s
 *   while reset is 1: out = initial
 *
 * Failure: While the input, or the sum, is not finite, `out` keeps its value.
 */
struct integrator {
    double initial;
};

static const struct fl_parameter integrator_parameters[] = {
    FL_PARAMETER(struct integrator, initial, .default_value = "0",
                 .summary = "out in the first step and after a reset"),
};

static const struct fl_port integrator_inputs[] = {
    {.name = "in",
     .type = FL_DOUBLE,
     .width = 1,
     .flags = FL_DELAYED,
     .summary = "any signal; while it is not finite it counts as zero"},
    {.name = "reset", .type = FL_BOOLEAN, .width = 1, .flags = FL_OPTIONAL, .summary = "1: out is its initial value"},
};

static const struct fl_port integrator_outputs[] = {
    {.name = "out", .type = FL_DOUBLE, .width = 1, .summary = "the integral up to this step, of in before it"},
};

static int initialize_integrator(struct fl_block *block)
{
    const struct integrator *integrator = block->parameters;
    FL_OUT(block, 0, double) = integrator->initial;
    return FL_OK;
}

static int step_integrator(struct fl_block *block)
{
    double grown = FL_OUT(block, 0, double) + fl_interval_s(block) * FL_IN(block, 0, double);
    if (FL_IN(block, 1, uint8_t))
        return initialize_integrator(block);
    if (block->step && isfinite(grown))
        FL_OUT(block, 0, double) = grown;
    return FL_OK;
}

FL_BLOCK(integrator) = {
    .abi = FL_ABI,
    .name = "integrator",
    .summary = "integrates a signal over time (forward Euler); may close a loop",
    .source = "Simulink's block Discrete-Time Integrator, method Forward Euler",
    FL_TABLE(input, integrator_inputs),
    FL_TABLE(output, integrator_outputs),
    FL_TABLE(parameter, integrator_parameters),
    .parameters_size = sizeof(struct integrator),
    .initialize = initialize_integrator,
    .step = step_integrator,
};
