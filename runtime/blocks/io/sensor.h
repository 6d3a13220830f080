/* The outputs that FL_SENSOR_OUTPUTS lists, for blocks that hear of the world by messages. */
#ifndef FLOTILLA_IO_SENSOR_H
#define FLOTILLA_IO_SENSOR_H

#include <flotilla/block.h>
#include <math.h>

struct sensor {
    int64_t arrived_ns; /* of the last value; before the first, when the block started */
    uint32_t sequence;  /* values so far */
    bool good;          /* whether the last message was a value */
};

/* At start: nothing has arrived, and ages count from here. */
static inline void sensor_start(struct sensor *sensor)
{
    *sensor = (struct sensor){.arrived_ns = fl_now_ns()};
}

static inline void sensor_arrived(struct sensor *sensor, int64_t arrived_ns)
{
    *sensor = (struct sensor){arrived_ns, sensor->sequence + 1, true};
}

/* Write flag, age and sequence to the outputs from `first` on. A value as old as `timeout` is still good. */
static inline void sensor_outputs(const struct sensor *sensor, struct fl_block *block, uint32_t first, double timeout)
{
    /* What came between the release of this step and now is new, not from the future. */
    int64_t age_ns = block->release_ns > sensor->arrived_ns ? block->release_ns - sensor->arrived_ns : 0;
    FL_OUT(block, first, bool) = sensor->good && age_ns <= llround(timeout * 1e9);
    FL_OUT(block, first + 1, double) = (double)age_ns / 1e9;
    FL_OUT(block, first + 2, uint32_t) = sensor->sequence;
}

#endif
