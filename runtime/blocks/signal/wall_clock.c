#define _GNU_SOURCE
#include "wall_clock.h"

#include <flotilla/block.h>
#include <time.h>

int64_t wall_less_monotonic_ns(void)
{
    struct timespec wall;
    int64_t before = fl_now_ns();
    clock_gettime(CLOCK_REALTIME, &wall);
    int64_t after = fl_now_ns();
    return wall.tv_sec * INT64_C(1000000000) + wall.tv_nsec - (before + (after - before) / 2);
}
