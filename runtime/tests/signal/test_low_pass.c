#include "testbed.h"

#include <math.h>

static double filtered(struct fl_block *filter, double in)
{
    SET(filter, "in", double, in);
    assert_int_equal(testbed_step(filter), FL_OK);
    return GET(filter, "out", double);
}

/* The answer to a step is 1 - exp(-t/T), whatever the period. */
static void follows_the_exponential(void **state)
{
    (void)state;
    struct fl_block *filter = testbed_block("low-pass", "time_constant", "0.05", NULL);
    struct fl_block *other = testbed_block("low-pass", "time_constant", "0.2", NULL);
    testbed_begin(filter);
    testbed_begin(other);
    assert_near(filtered(filter, 3), 3, 0); /* no swing at the beginning */
    assert_near(filtered(other, 3), 3, 0);
    for (int i = 1; i <= 100; i++) {
        assert_near(filtered(filter, 5), 3 + 2 * (1 - exp(-0.01 * i / 0.05)), 1e-12);
        assert_near(filtered(other, 5), 3 + 2 * (1 - exp(-0.01 * i / 0.2)), 1e-12);
    }
    testbed_end(filter);
    testbed_end(other);
}

/* Late steps, as where some were left out: the same curve. */
static void follows_the_exponential_in_late_steps(void **state)
{
    (void)state;
    struct fl_block *filter = testbed_block("low-pass", "time_constant", "0.5", NULL);
    double time = 0;
    testbed_begin(filter);
    assert_near(filtered(filter, 3), 3, 0);
    SET(filter, "in", double, 5);
    for (int i = 0; i < 10; i++) {
        assert_int_equal(testbed_step_after(filter, 35000000), FL_OK);
        time += 0.035;
        assert_near(GET(filter, "out", double), 3 + 2 * (1 - exp(-time / 0.5)), 1e-12);
    }
    testbed_end(filter);
}

static void leaves_out_what_is_not_finite(void **state)
{
    (void)state;
    struct fl_block *filter = testbed_block("low-pass", "time_constant", "0.05", NULL);
    testbed_begin(filter);
    assert_near(filtered(filter, NAN), 0, 0);
    assert_near(filtered(filter, 3), 3, 0);
    assert_near(filtered(filter, INFINITY), 3, 0);
    assert_near(filtered(filter, NAN), 3, 0);
    assert_near(filtered(filter, 5), 3 + 2 * (1 - exp(-0.2)), 1e-12);
    testbed_end(filter);
}

static void without_time_constant_it_is_a_wire(void **state)
{
    (void)state;
    struct fl_block *filter = testbed_block("low-pass", "time_constant", "0", NULL);
    testbed_begin(filter);
    filtered(filter, 1);
    assert_near(filtered(filter, -4), -4, 0);
    testbed_end(filter);
    assert_non_null(strstr(testbed_refusal("low-pass", "time_constant", "-1", NULL), "-1 is outside 0 to inf s"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(follows_the_exponential),
        cmocka_unit_test(follows_the_exponential_in_late_steps),
        cmocka_unit_test(leaves_out_what_is_not_finite),
        cmocka_unit_test(without_time_constant_it_is_a_wire),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
