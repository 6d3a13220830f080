/* The outputs that every sensor block has beside its values: flag, age and sequence.
 *
 *   value      the last good value; it stays when later ones are bad or none come
 *   flag       1: the last measurement was good, is not older than `timeout`, and its source was connected ever since
 *   age        time since that good value arrived; before the first one, since the block began
 *   sequence   increases with each good value only, by more than one where the task missed some
 *
 * So a block that acts on new values may use the flag or the sequence alone.
 */
#ifndef FLOTILLA_SENSOR_H
#define FLOTILLA_SENSOR_H

#include <flotilla/block.h>

/* The three outputs, one after the other. */
#define FL_SENSOR_OUTPUTS                                                                                              \
    {.name = "flag", .type = FL_BOOLEAN, .width = 1, .summary = "1: the value is good and not older than `timeout`"},  \
        {.name = "age", .type = FL_DOUBLE, .width = 1, .unit = "s", .summary = "time since the value arrived"},        \
        {.name = "sequence", .type = FL_UINT32, .width = 1, .summary = "increases with each good value"}

/* The parameter `double timeout` of the structure `type`. */
#define FL_SENSOR_TIMEOUT(type, seconds)                                                                               \
    FL_PARAMETER(type, timeout, .flags = FL_TUNABLE, .default_value = (seconds), .min = 0.001, .max = 3600,            \
                 .unit = "s", .summary = "older values are not good")

struct fl_sensor {
    int64_t arrived_ns; /* of the last good value */
    uint32_t sequence;  /* number of the last good value, 0: none yet */
    bool good;          /* the last measurement was good, and its source was connected since */
};

/* For start or initialize: ages count from here. */
void fl_sensor_begin(struct fl_sensor *sensor);

/* A good value came, and the block writes it to its outputs. `sequence` counts what the source sends, from 1; for a
 * source without a count pass sensor->sequence + 1. */
void fl_sensor_update(struct fl_sensor *sensor, int64_t arrived_ns, uint32_t sequence);

/* A bad measurement came. */
void fl_sensor_invalidate(struct fl_sensor *sensor);

/* For the step: write the three outputs, of which `flag` is the number of the first. `there`: the source is connected;
 * after a loss only a new value is good. */
void fl_sensor_outputs(struct fl_sensor *sensor, struct fl_block *block, uint32_t flag, bool there, double timeout);

#endif
