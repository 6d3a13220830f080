#define _GNU_SOURCE
#include "testbed.h"

#include <time.h>

static int64_t wall_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static void tells_the_time_of_the_step(void **state)
{
    (void)state;
    struct fl_block *clock = testbed_block("clock", NULL), *other = testbed_block("clock", NULL);
    testbed_begin(clock);
    testbed_begin(other);
    for (uint64_t i = 0; i < 300; i++) {
        assert_int_equal(testbed_step(clock), FL_OK);
        assert_near(GET(clock, "time", double), 0.01 * (double)i, 1e-12);
        assert_int_equal(GET(clock, "step", uint64_t), i);
        assert_int_equal(GET(clock, "monotonic_ns", int64_t), clock->release_ns);
    }
    testbed_step(other);
    assert_near(GET(other, "time", double), 0, 0);
    testbed_end(clock);
    testbed_end(other);
}

/* The two clocks are read one after the other here, so that their true difference lies between. */
static void tells_the_wall_clock(void **state)
{
    (void)state;
    struct fl_block *clock = testbed_block("clock", NULL);
    testbed_begin(clock);
    int64_t wall_before = wall_ns(), before = fl_now_ns();
    testbed_step(clock);
    int64_t after = fl_now_ns(), wall_after = wall_ns();
    int64_t offset = GET(clock, "offset_ns", int64_t);
    assert_in_range(offset, wall_before - after, wall_after - before);
    assert_int_equal(GET(clock, "wall_ns", int64_t), clock->release_ns + offset);
    assert_near(GET(clock, "wall", double), 1e-9 * (double)(clock->release_ns + offset), 2.4e-7);
    testbed_end(clock);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(tells_the_time_of_the_step),
        cmocka_unit_test(tells_the_wall_clock),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
