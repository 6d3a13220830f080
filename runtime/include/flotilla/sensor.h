/* What every sensor block has: the outputs flag, age and sequence beside its values, with one meaning.
 *
 *   value      the last good one; it stays when what comes after it is bad, or nothing comes
 *   flag       1: the last measurement was good, is not older than `timeout`, and its source was there ever since
 *   age        time since that good value arrived; before the first, since the block began
 *   sequence   moves on with each good value and with nothing else, by more than one where the task missed some
 *
 * So a block that acts upon new values may go by the flag or by the sequence alone.
 */
#ifndef FLOTILLA_SENSOR_H
#define FLOTILLA_SENSOR_H

#include <flotilla/block.h>

/* The three outputs, one after the other. */
#define FL_SENSOR_OUTPUTS                                                                                              \
    {.name = "flag", .type = FL_BOOLEAN, .width = 1, .summary = "1: the value is good and not older than `timeout`"},  \
        {.name = "age", .type = FL_DOUBLE, .width = 1, .unit = "s", .summary = "time since the value arrived"},        \
        {.name = "sequence", .type = FL_UINT32, .width = 1, .summary = "moves on with each good value"}

/* The parameter `double timeout` of the structure `type`. */
#define FL_SENSOR_TIMEOUT(type, seconds)                                                                               \
    FL_PARAMETER(type, timeout, .flags = FL_TUNABLE, .fallback = (seconds), .min = 0.001, .max = 3600, .unit = "s",    \
                 .summary = "a value that is older is not good")

struct fl_sensor {
    int64_t arrived_ns; /* of the last good value */
    uint32_t sequence;  /* of it, 0: none yet */
    bool good;          /* what came last was a value, and its source was there since */
};

/* At start or initialize: ages count from here. */
void fl_sensor_begin(struct fl_sensor *sensor);

/* A good value came, and is to be written to the outputs. `sequence` counts what its source sends, from 1; a source
 * that has no count gives sensor->sequence + 1. */
void fl_sensor_update(struct fl_sensor *sensor, int64_t arrived_ns, uint32_t sequence);

/* A measurement came that is not good. */
void fl_sensor_invalidate(struct fl_sensor *sensor);

/* Write the outputs, of which the flag is number `flag`. `there`: the source is; once it was not, only a new value is
 * good. For the step. */
void fl_sensor_outputs(struct fl_sensor *sensor, struct fl_block *block, uint32_t flag, bool there, double timeout);

#endif
