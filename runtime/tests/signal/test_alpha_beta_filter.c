#include "testbed.h"

#include <math.h>

static void filtered(struct fl_block *filter, double measurement, uint32_t sequence)
{
    SET(filter, "measurement", double, measurement);
    SET(filter, "sequence", uint32_t, sequence);
    assert_int_equal(testbed_step(filter), FL_OK);
}

static void begins_at_the_first_measurement_at_rest(void **state)
{
    (void)state;
    struct fl_block *filter = testbed_block("alpha-beta-filter", "time_constant", "0.1", NULL);
    testbed_begin(filter);
    filtered(filter, 5, 0); /* nothing was measured yet */
    assert_near(GET(filter, "value", double), 0, 0);
    filtered(filter, 3, 1);
    assert_near(GET(filter, "value", double), 3, 0);
    assert_near(GET(filter, "rate", double), 0, 0);
    testbed_end(filter);
}

/* The first correction by the formulas of the source, with fade = exp(-0.01/0.1). */
static void corrects_by_the_gains(void **state)
{
    (void)state;
    struct fl_block *filter = testbed_block("alpha-beta-filter", "time_constant", "0.1", NULL);
    double fade = exp(-0.1);
    testbed_begin(filter);
    filtered(filter, 1, 1);
    filtered(filter, 2, 2);
    assert_near(GET(filter, "value", double), 1 + (1 - fade * fade), 1e-12);
    assert_near(GET(filter, "rate", double), (1 - fade) * (1 - fade) / 0.01, 1e-9);
    testbed_end(filter);
}

/* Whatever moves evenly is followed without error, also where a measurement comes in each third step only. */
static void follows_a_constant_rate(void **state)
{
    (void)state;
    for (uint32_t every = 1; every <= 3; every += 2) {
        struct fl_block *filter = testbed_block("alpha-beta-filter", "time_constant", "0.1", NULL);
        testbed_begin(filter);
        for (uint32_t i = 0; i < 600; i++)
            filtered(filter, 0.02 * (i - i % every), 1 + i / every);
        /* The last step was number 599. */
        assert_near(GET(filter, "rate", double), 2, 1e-9);
        assert_near(GET(filter, "value", double), 0.02 * 599, 1e-9);
        testbed_end(filter);
    }
}

static void goes_on_by_itself_without_measurements(void **state)
{
    (void)state;
    struct fl_block *filter = testbed_block("alpha-beta-filter", "time_constant", "0.1", NULL);
    testbed_begin(filter);
    for (uint32_t i = 0; i < 600; i++)
        filtered(filter, 0.02 * i, i + 1);
    for (int i = 0; i < 50; i++)
        filtered(filter, i % 2 ? NAN : -7, i % 2 ? 601 : 600); /* not new, or no number */
    assert_near(GET(filter, "value", double), 0.02 * 649, 1e-9);
    filtered(filter, 0.02 * 650, 601);
    assert_near(GET(filter, "value", double), 0.02 * 650, 1e-9);
    testbed_end(filter);
}

/* An acceleration that is known is followed without error, too. */
static void follows_a_known_acceleration(void **state)
{
    (void)state;
    struct fl_block *filter = testbed_block("alpha-beta-filter", "time_constant", "0.1", NULL);
    testbed_begin(filter);
    for (uint32_t i = 0; i < 600; i++) {
        double time = 0.01 * i;
        SET(filter, "acceleration", double, i ? 3 : 0); /* of the period before the measurement */
        filtered(filter, 1.5 * time * time, i + 1);
        assert_near(GET(filter, "value", double), 1.5 * time * time, 1e-9);
        assert_near(GET(filter, "rate", double), 3 * time, 1e-9);
    }
    SET(filter, "acceleration", double, NAN);
    filtered(filter, 0, 600);
    assert_near(GET(filter, "rate", double), 3 * 5.99, 1e-9);
    testbed_end(filter);
}

/* Steps of 10, 35 and 0 ms, and a measurement in every other one. */
static void follows_in_late_steps(void **state)
{
    (void)state;
    static const int64_t intervals_ns[] = {10000000, 35000000, 0, 5000000, 80000000};
    struct fl_block *filter = testbed_block("alpha-beta-filter", "time_constant", "0.1", NULL);
    double time = 0;
    testbed_begin(filter);
    for (uint32_t i = 0; i < 1000; i++) {
        int64_t interval_ns = intervals_ns[i % 5];
        time += i ? 1e-9 * (double)interval_ns : 0;
        SET(filter, "measurement", double, 2 * time);
        SET(filter, "sequence", uint32_t, 1 + i / 2);
        assert_int_equal(testbed_step_after(filter, interval_ns), FL_OK);
    }
    assert_near(GET(filter, "rate", double), 2, 1e-9);
    assert_near(GET(filter, "value", double), 2 * time, 1e-9);
    testbed_end(filter);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(begins_at_the_first_measurement_at_rest),
        cmocka_unit_test(corrects_by_the_gains),
        cmocka_unit_test(follows_a_constant_rate),
        cmocka_unit_test(goes_on_by_itself_without_measurements),
        cmocka_unit_test(follows_a_known_acceleration),
        cmocka_unit_test(follows_in_late_steps),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
