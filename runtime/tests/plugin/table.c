/* The rows of a file as signals: what a test gives a block, step by step. After the last row it stays as it is. */
#include <errno.h>
#include <flotilla/block.h>
#include <stdio.h>
#include <string.h>

struct table {
    const char *file; /* doubles of this computer, row by row */
    int64_t width, rows;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct table, file, .summary = "doubles, row by row"),
    FL_PARAMETER(struct table, width, .min = 1, .max = 65536, .summary = "doubles of a row"),
    FL_PARAMETER(struct table, rows, .min = 1, .max = 1e7, .summary = "rows of the file"),
};

struct state {
    double *values;
};

enum { OUT, ON, BYTES, COUNT };

static int configure(struct fl_block *block)
{
    const struct table *set = block->parameters;
    uint32_t width = (uint32_t)set->width;
    const struct fl_port outputs[] = {
        {.name = "out", .type = FL_DOUBLE, .width = width, .summary = "the row"},
        {.name = "on", .type = FL_BOOLEAN, .width = width, .summary = "out > 0.5"},
        {.name = "bytes", .type = FL_UINT8, .width = width, .summary = "out, of 0 to 255"},
        {.name = "count", .type = FL_UINT32, .width = 1, .summary = "rows so far"},
    };
    for (size_t i = 0; i < sizeof outputs / sizeof outputs[0]; i++)
        if (fl_add_output(block, outputs[i]) != FL_OK)
            return FL_FAILED;
    return FL_OK;
}

static int start(struct fl_block *block)
{
    const struct table *set = block->parameters;
    struct state *state = block->state;
    size_t count = (size_t)(set->width * set->rows);
    state->values = fl_allocate(block, count * sizeof *state->values);
    FILE *file = state->values ? fopen(set->file, "rb") : NULL;
    if (!file)
        return fl_fail(block, "%s: %s", set->file, strerror(errno));
    size_t found = fread(state->values, sizeof *state->values, count, file);
    fclose(file);
    return found == count ? FL_OK : fl_fail(block, "%s has %zu numbers of %zu", set->file, found, count);
}

static int step(struct fl_block *block)
{
    const struct table *set = block->parameters;
    const struct state *state = block->state;
    int64_t row = (int64_t)block->step < set->rows ? (int64_t)block->step : set->rows - 1;
    const double *values = state->values + row * set->width;
    memcpy(block->out[OUT], values, (size_t)set->width * sizeof *values);
    for (int64_t i = 0; i < set->width; i++) {
        ((bool *)block->out[ON])[i] = values[i] > 0.5;
        ((uint8_t *)block->out[BYTES])[i] = values[i] > 0 && values[i] < 256 ? (uint8_t)values[i] : 0;
    }
    FL_OUT(block, COUNT, uint32_t) = (uint32_t)block->step + 1;
    return FL_OK;
}

FL_BLOCK(table) = {
    .abi = FL_ABI,
    .name = "table",
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct table),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
};
