/* saw-tooth: a sawtooth. A block to begin with; docs/how-to/blocks.md says more. */
#include <flotilla/block.h>

struct saw_tooth {
    double rate;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct saw_tooth, rate, .flags = FL_TUNABLE, .default_value = "1", .min = 0, .max = 100, .unit = "1/s",
                 .summary = "teeth a second"),
};
static const struct fl_port outputs[] = {
    {.name = "out", .type = FL_DOUBLE, .width = 1, .summary = "rises from 0, and falls back before 1"},
};

static int step(struct fl_block *block)
{
    const struct saw_tooth *wanted = block->parameters;
    double *phase = block->state;
    *phase += wanted->rate * fl_interval_s(block);
    *phase -= (double)(int64_t)*phase;
    FL_OUT(block, 0, double) = *phase;
    return FL_OK;
}

FL_BLOCK(saw_tooth) = {
    .abi = FL_ABI,
    .name = "saw-tooth",
    .summary = "a sawtooth",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct saw_tooth),
    .state_size = sizeof(double),
    .step = step,
};
