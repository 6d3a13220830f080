#include "testbed.h"

#include "executive/ticks.h"

#include <math.h>

static void a_tick_has_a_length(void **state)
{
    (void)state;
    assert_true(fabs(ticks_ns((struct moment){0, 0}, (struct moment){2000, 1000}) - 0.5) < 1e-12);
    assert_true(fabs(ticks_ns((struct moment){7, 7}, (struct moment){7, 7}) - 1) < 1e-12);
}

static struct moment after_a_while(bool counter)
{
    for (int64_t begin_ns = fl_now_ns(); fl_now_ns() < begin_ns + 10 * 1000 * 1000;)
        continue;
    return ticks_moment(counter);
}

/* Two clocks that go evenly agree at all times. Seen to fail with moments whose clocks are read 1 ms apart now and
 * then, and with a tick of CLOCK_MONOTONIC that is half a nanosecond. */
static void both_clocks_go_evenly(void **state)
{
    (void)state;
    for (int counter = 0; counter <= ticks_constant(); counter++) {
        struct moment first = ticks_moment(counter), second = after_a_while(counter), third = after_a_while(counter);
        double before_ns = ticks_ns(first, second), after_ns = ticks_ns(second, third);
        assert_true(fabs(before_ns / after_ns - 1) < 0.01);
        if (!counter)
            assert_true(fabs(before_ns - 1) < 0.01);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(a_tick_has_a_length), cmocka_unit_test(both_clocks_go_evenly)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
