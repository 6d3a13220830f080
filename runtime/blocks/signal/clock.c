/** clock
 *
 * Gives the time of the step by the monotonic clock, which is never set, and by the wall clock.
 *
 * Equations:
 *   time = monotonic_ns − monotonic_ns of the first step, in s
 *   wall_ns = monotonic_ns + offset_ns
 *
 * Failure: Cannot fail. When the wall clock is set, `offset_ns`, `wall_ns` and `wall` jump; `time` and `monotonic_ns`
 * never do.
 */
#include "core/wall_clock.h"

#include <flotilla/block.h>

enum { TIME, STEP, MONOTONIC, OFFSET, WALL_NS, WALL, NOW };

struct state {
    int64_t begin_ns;
};

static const struct fl_port inputs[] = {
    {.name = "after",
     .type = FL_BOOLEAN,
     .width = 1,
     .flags = FL_OPTIONAL,
     .summary = "wire any flag here to run after its block"},
};

static const struct fl_port outputs[] = {
    {.name = "time", .type = FL_DOUBLE, .width = 1, .unit = "s", .summary = "since the first step was due"},
    {.name = "step", .type = FL_UINT64, .width = 1, .summary = "steps before this one"},
    {.name = "monotonic_ns",
     .type = FL_INT64,
     .width = 1,
     .unit = "ns",
     .summary = "when this step was due, by the clock that is never set"},
    {.name = "offset_ns",
     .type = FL_INT64,
     .width = 1,
     .unit = "ns",
     .summary = "wall clock less monotonic clock, as of this step: it jumps when the wall clock is set"},
    {.name = "wall_ns",
     .type = FL_INT64,
     .width = 1,
     .unit = "ns",
     .summary = "when this step was due, since 1970-01-01 UTC"},
    {.name = "wall", .type = FL_DOUBLE, .width = 1, .unit = "s", .summary = "the same, rounded to 0.24 µs"},
    {.name = "now_ns",
     .type = FL_INT64,
     .width = 1,
     .unit = "ns",
     .summary = "when this block ran, by the clock that is never set"},
};

static int step(struct fl_block *block)
{
    struct state *state = block->state;
    int64_t offset = fl_wall_less_monotonic_ns();
    if (block->step == 0)
        state->begin_ns = block->release_ns;
    FL_OUT(block, TIME, double) = 1e-9 * (double)(block->release_ns - state->begin_ns);
    FL_OUT(block, STEP, uint64_t) = block->step;
    FL_OUT(block, MONOTONIC, int64_t) = block->release_ns;
    FL_OUT(block, OFFSET, int64_t) = offset;
    FL_OUT(block, WALL_NS, int64_t) = block->release_ns + offset;
    FL_OUT(block, WALL, double) = 1e-9 * (double)(block->release_ns + offset);
    FL_OUT(block, NOW, int64_t) = fl_now_ns();
    return FL_OK;
}

FL_BLOCK(clock) = {
    .abi = FL_ABI,
    .name = "clock",
    .summary = "the time of the step, by the monotonic and by the wall clock",
    .source = "clock_gettime(2): CLOCK_MONOTONIC, CLOCK_REALTIME",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    .state_size = sizeof(struct state),
    .step = step,
};
