/* What the blocks with a serial port share: the outputs that FL_SENSOR_OUTPUTS lists. */
#ifndef FLOTILLA_SERIAL_SENSOR_H
#define FLOTILLA_SERIAL_SENSOR_H

#include <flotilla/driver.h>

struct sensor {
    int64_t arrived_ns; /* of the value that the outputs hold; before the first, when the block started */
    uint32_t sequence;  /* measurements so far, bad ones included */
    bool good;          /* the last measurement was */
};

/* At initialize: nothing has arrived, and ages count from here. */
static inline void sensor_begin(struct sensor *sensor)
{
    *sensor = (struct sensor){.arrived_ns = fl_now_ns()};
}

/* A measurement came. True when it is good, and its values are to be written to the outputs; else the last good ones
 * stay there, and their age grows. */
static inline bool sensor_take(struct sensor *sensor, bool good, int64_t arrived_ns, uint32_t sequence)
{
    sensor->good = good;
    sensor->sequence = sequence;
    if (good)
        sensor->arrived_ns = arrived_ns;
    return good;
}

/* Write flag, age and sequence, the last three outputs. A value as old as `timeout` is still good; but when the device
 * was gone, however briefly, only a new one is. */
static inline void sensor_outputs(struct sensor *sensor, struct fl_block *block, bool connected, double timeout)
{
    uint32_t first = block->out_count - 3;
    sensor->good = sensor->good && connected;
    /* What came between the release of this step and now is new, not from the future. */
    int64_t age_ns = block->release_ns > sensor->arrived_ns ? block->release_ns - sensor->arrived_ns : 0;
    FL_OUT(block, first, bool) = sensor->good && (double)age_ns <= timeout * 1e9;
    FL_OUT(block, first + 1, double) = (double)age_ns / 1e9;
    FL_OUT(block, first + 2, uint32_t) = sensor->sequence;
}

#define SENSOR_TIMEOUT(type, seconds)                                                                                  \
    FL_PARAMETER(type, timeout, .flags = FL_TUNABLE, .fallback = seconds, .min = 0.001, .max = 3600, .unit = "s",      \
                 .summary = "a value that is older is not good")

#endif
