#define _GNU_SOURCE
#include "wall_clock.h"

#include <flotilla/block.h>
#include <time.h>

enum {
    CLOSE_NS = 20 * 1000, /* two readings this close were not interrupted */
    READINGS = 4,
};

/* An interruption between the two clocks makes the difference wrong by half of its duration, so the closest pair of
 * readings counts. */
int64_t fl_wall_less_monotonic_ns(void)
{
    int64_t closest_ns = INT64_MAX, difference_ns = 0;
    for (int i = 0; i < READINGS && closest_ns > CLOSE_NS; i++) {
        struct timespec wall;
        int64_t before_ns = fl_now_ns();
        clock_gettime(CLOCK_REALTIME, &wall);
        int64_t apart_ns = fl_now_ns() - before_ns;
        if (apart_ns >= closest_ns)
            continue;
        closest_ns = apart_ns;
        difference_ns = wall.tv_sec * INT64_C(1000000000) + wall.tv_nsec - (before_ns + apart_ns / 2);
    }
    return difference_ns;
}
