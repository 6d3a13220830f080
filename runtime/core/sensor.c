#include <flotilla/sensor.h>
#include <math.h>

void fl_sensor_begin(struct fl_sensor *sensor)
{
    *sensor = (struct fl_sensor){.arrived_ns = fl_now_ns()};
}

void fl_sensor_update(struct fl_sensor *sensor, int64_t arrived_ns, uint32_t sequence)
{
    *sensor = (struct fl_sensor){arrived_ns, sequence, true};
}

void fl_sensor_invalidate(struct fl_sensor *sensor)
{
    sensor->good = false;
}

void fl_sensor_outputs(struct fl_sensor *sensor, struct fl_block *block, uint32_t flag, bool there, double timeout)
{
    /* A value that arrived after the release of this step has age 0. */
    int64_t age_ns = block->release_ns > sensor->arrived_ns ? block->release_ns - sensor->arrived_ns : 0;
    sensor->good = sensor->good && there;
    FL_OUT(block, flag, bool) = sensor->good && age_ns <= llround(timeout * 1e9);
    FL_OUT(block, flag + 1, double) = (double)age_ns / 1e9;
    FL_OUT(block, flag + 2, uint32_t) = sensor->sequence;
}
