#include "testbed.h"

#include <math.h>

static double limited(struct fl_block *limit, double in)
{
    SET(limit, "in", double, in);
    assert_int_equal(testbed_step(limit), FL_OK);
    return GET(limit, "out", double);
}

static void keeps_the_range(void **state)
{
    (void)state;
    struct fl_block *limit = testbed_block("limit", "min", "-1", "max", "2", NULL);
    testbed_begin(limit);
    assert_near(limited(limit, 1.5), 1.5, 0);
    assert_false(GET(limit, "limited", uint8_t));
    assert_near(limited(limit, 2.5), 2, 0);
    assert_true(GET(limit, "limited", uint8_t));
    assert_near(limited(limit, -7), -1, 0);
    assert_near(limited(limit, INFINITY), 2, 0);
    assert_near(limited(limit, -INFINITY), -1, 0);
    assert_near(limited(limit, 0.5), 0.5, 0);
    testbed_end(limit);
}

static void holds_while_in_is_not_a_number(void **state)
{
    (void)state;
    struct fl_block *limit = testbed_block("limit", "min", "-1", "max", "2", NULL);
    testbed_begin(limit);
    limited(limit, 0.75);
    assert_near(limited(limit, NAN), 0.75, 0);
    assert_true(GET(limit, "limited", uint8_t));
    assert_near(limited(limit, 1), 1, 0);
    testbed_end(limit);
}

/* 10 per second are 0.1 per period of 10 ms. */
static void keeps_the_rate(void **state)
{
    (void)state;
    struct fl_block *limit = testbed_block("limit", "min", "-1", "max", "1", "rate", "10", "initial", "0.5", NULL);
    struct fl_block *other = testbed_block("limit", "min", "3", "max", "9", NULL);
    testbed_begin(limit);
    testbed_begin(other);
    assert_near(GET(limit, "out", double), 0.5, 0);
    assert_near(GET(other, "out", double), 3, 0); /* the initial value is limited too */
    for (int i = 1; i <= 5; i++)
        assert_near(limited(limit, 7), 0.5 + 0.1 * i, 1e-12);
    assert_near(limited(limit, 7), 1, 0);
    assert_near(limited(limit, -7), 0.9, 1e-12);
    assert_near(limited(limit, 0.85), 0.85, 0);
    assert_false(GET(limit, "limited", uint8_t));
    testbed_end(limit);
    testbed_end(other);
}

static void keeps_the_rate_in_late_steps(void **state)
{
    (void)state;
    struct fl_block *limit = testbed_block("limit", "min", "-1", "max", "9", "rate", "10", NULL);
    testbed_begin(limit);
    assert_near(limited(limit, 7), 0.1, 1e-12);
    testbed_step_after(limit, 35000000);
    assert_near(GET(limit, "out", double), 0.45, 1e-12);
    testbed_step_after(limit, 0);
    assert_near(GET(limit, "out", double), 0.45, 1e-12);
    testbed_end(limit);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("limit", "min", "2", "max", "1", NULL), "min 2 is above max 1"));
    assert_non_null(
        strstr(testbed_refusal("limit", "min", "0", "max", "1", "rate", "-1", NULL), "-1 is outside 0 to inf"));
    assert_non_null(strstr(testbed_refusal("limit", "min", "0", NULL), "parameter max of limit is missing"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(keeps_the_range), cmocka_unit_test(holds_while_in_is_not_a_number),
        cmocka_unit_test(keeps_the_rate),  cmocka_unit_test(keeps_the_rate_in_late_steps),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
