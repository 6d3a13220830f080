#define _GNU_SOURCE
#include "wall_clock.h"

#include <flotilla/block.h>
#include <stdlib.h>

enum {
    CLOSE_NS = 20 * 1000, /* two readings this close were not interrupted */
    READINGS = 4,
};

_Static_assert(sizeof(time_t) == sizeof(int64_t), "seconds until 2038 alone; define _TIME_BITS=64");

int64_t fl_clock_ns(clockid_t clock)
{
    struct timespec now;
    if (clock_gettime(clock, &now) < 0)
        abort();
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

int64_t fl_now_ns(void)
{
    return fl_clock_ns(CLOCK_MONOTONIC);
}

/* An interruption between the two clocks makes the difference wrong by half of its duration, so the closest pair of
 * readings counts. */
int64_t fl_wall_less_monotonic_ns(void)
{
    int64_t closest_ns = INT64_MAX, difference_ns = 0;
    for (int i = 0; i < READINGS && closest_ns > CLOSE_NS; i++) {
        int64_t before_ns = fl_now_ns(), wall_ns = fl_clock_ns(CLOCK_REALTIME);
        int64_t apart_ns = fl_now_ns() - before_ns;
        if (apart_ns >= closest_ns)
            continue;
        closest_ns = apart_ns;
        difference_ns = wall_ns - (before_ns + apart_ns / 2);
    }
    return difference_ns;
}
