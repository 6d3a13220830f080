#include "testbed.h"

#include <math.h>

static const double h = 0.01; /* the testbed's period */

static double controlled(struct fl_block *pid, double set_point, double measurement)
{
    SET(pid, "set_point", double, set_point);
    SET(pid, "measurement", double, measurement);
    assert_int_equal(testbed_step(pid), FL_OK);
    return GET(pid, "out", double);
}

static void proportional(void **state)
{
    (void)state;
    struct fl_block *pid = testbed_block("pid", "kp", "2", "min", "-10", "max", "10", NULL);
    testbed_begin(pid);
    assert_near(controlled(pid, 3, 1), 4, 0);
    SET(pid, "feed_forward", double, 0.5);
    assert_near(controlled(pid, 3, 1), 4.5, 0);
    assert_false(GET(pid, "saturated", uint8_t));
    assert_near(controlled(pid, 30, 1), 10, 0);
    assert_true(GET(pid, "saturated", uint8_t));
    assert_near(controlled(pid, -30, 1), -10, 0);
    testbed_end(pid);
}

/* The sum of a constant error's steps, as of the step before. */
static void integral(void **state)
{
    (void)state;
    struct fl_block *pid = testbed_block("pid", "ki", "5", "min", "-10", "max", "10", NULL);
    struct fl_block *other = testbed_block("pid", "ki", "1", "min", "-10", "max", "10", NULL);
    testbed_begin(pid);
    testbed_begin(other);
    for (int i = 0; i < 50; i++) {
        assert_near(controlled(pid, 3, 1), 5 * 2 * h * i, 1e-12);
        assert_near(controlled(other, 1, 2), -h * i, 1e-12);
    }
    SET(pid, "reset", uint8_t, 1);
    assert_near(controlled(pid, 3, 1), 0, 0);
    SET(pid, "reset", uint8_t, 0);
    assert_near(controlled(pid, 3, 1), 0, 0);
    assert_near(controlled(pid, 3, 1), 5 * 2 * h, 1e-12);
    testbed_end(pid);
    testbed_end(other);
}

/* Of a ramp r t the filtered derivative is r (1 - (T/(T+h))^n); a jump of the set point does not show in it. */
static void derivative(void **state)
{
    (void)state;
    struct fl_block *pid = testbed_block("pid", "kd", "3", "filter", "0.05", "min", "-99", "max", "99", NULL);
    struct fl_block *raw = testbed_block("pid", "kd", "3", "min", "-99", "max", "99", NULL);
    testbed_begin(pid);
    testbed_begin(raw);
    for (int i = 0; i < 50; i++) {
        double measurement = 7 + 2 * h * i;
        assert_near(controlled(pid, i * i, measurement), -3 * 2 * (1 - pow(0.05 / (0.05 + h), i)), 1e-9);
        assert_near(controlled(raw, i * i, measurement), i ? -6 : 0, 1e-9); /* no kick at the first step */
    }
    testbed_end(pid);
    testbed_end(raw);
}

/* How many steps the output stays at its limit after an error of 1 during 200 steps turned to -1. */
static int steps_to_recover(const char *anti_windup)
{
    struct fl_block *pid = testbed_block("pid", "kp", "1", "ki", "10", "min", "-2", "max", "2", "anti_windup",
                                         anti_windup, "tracking", "0.02", NULL);
    int steps = 0;
    testbed_begin(pid);
    for (int i = 0; i < 200; i++)
        assert_true(controlled(pid, 1, 0) <= 2);
    assert_near(GET(pid, "out", double), 2, 0);
    while (steps < 1000 && controlled(pid, -1, 0) >= 2)
        steps++;
    testbed_end(pid);
    return steps;
}

static void does_not_wind_up(void **state)
{
    (void)state;
    /* Without: the integral stands at 20 and falls by 0.1 a step; kp takes 1 more off: at 3 after 170 steps, 169 or 171
     * by rounding. */
    int none = steps_to_recover("none");
    assert_in_range(none, 169, 171);
    /* Clamping keeps the integral where kp and it just reach the limit: 1, and the output is at 0 at once. */
    assert_int_equal(steps_to_recover("clamping"), 0);
    assert_int_equal(steps_to_recover("back-calculation"), 0);
}

/* In balance ki h e = h/Tt (wanted - out): the integral stands ki Tt e above the limit less kp e. */
static void back_calculation_finds_its_balance(void **state)
{
    (void)state;
    struct fl_block *pid = testbed_block("pid", "kp", "1", "ki", "10", "min", "-2", "max", "2", "anti_windup",
                                         "back-calculation", "tracking", "0.02", NULL);
    testbed_begin(pid);
    for (int i = 0; i < 500; i++)
        controlled(pid, 1, 0);
    /* With the error gone the output is the integral: 2 - 1 + 10 * 0.02. */
    assert_near(controlled(pid, 0, 0), 1.2, 1e-9);
    testbed_end(pid);
}

static void turns_the_short_way(void **state)
{
    (void)state;
    struct fl_block *pid = testbed_block("pid", "kp", "1", "kd", "1", "turn", "360", "min", "-999", "max", "999", NULL);
    testbed_begin(pid);
    assert_near(controlled(pid, 10, 350), 20, 1e-12);
    assert_near(controlled(pid, 10, 359), 11 - 9 / h, 1e-9);
    assert_near(controlled(pid, 10, 1), 9 - 2 / h, 1e-9); /* across zero: forward by 2, not back by 358 */
    assert_near(controlled(pid, 350, 1), -11, 1e-9);
    testbed_end(pid);
}

static void survives_what_is_not_finite(void **state)
{
    (void)state;
    struct fl_block *pid =
        testbed_block("pid", "kp", "1", "ki", "1", "kd", "1", "filter", "0.1", "min", "0.25", "max", "99", NULL);
    const double bad[] = {NAN, INFINITY, -INFINITY, 1.7e308, -1.7e308};
    testbed_begin(pid);
    assert_near(controlled(pid, 5, 1), 4, 0);
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
        double out = controlled(pid, 5, bad[i]);
        assert_true(out >= 0.25 && out <= 99);
        if (!isfinite(bad[i]))
            assert_near(out, 0.25, 0); /* zero, limited */
    }
    controlled(pid, NAN, 1);
    assert_near(GET(pid, "out", double), 0.25, 0);
    SET(pid, "feed_forward", double, NAN);
    assert_near(controlled(pid, 5, 1), 0.25, 0);
    SET(pid, "feed_forward", double, 0);
    controlled(pid, 5, 1);
    assert_true(isfinite(GET(pid, "out", double)));
    SET(pid, "reset", uint8_t, 1);
    controlled(pid, 5, 1);
    SET(pid, "reset", uint8_t, 0);
    assert_near(controlled(pid, 5, 1), 4, 0);
    testbed_end(pid);
}

static void its_integral_stays_finite(void **state)
{
    (void)state;
    struct fl_block *pid = testbed_block("pid", "ki", "1e9", "min", "-1", "max", "1", "anti_windup", "none", NULL);
    testbed_begin(pid);
    for (int i = 0; i < 3; i++)
        controlled(pid, 1e305, 0);
    assert_near(controlled(pid, 1, 0), 0, 0);
    assert_near(controlled(pid, 1e-10, 0), 1, 0);
    testbed_end(pid);
}

/* A fault of a few steps leaves the integral as it was, and the derivative does not see the gap. */
static void continues_after_a_fault(void **state)
{
    (void)state;
    struct fl_block *pid = testbed_block("pid", "ki", "1", "kd", "1", "min", "-99", "max", "99", NULL);
    testbed_begin(pid);
    for (int i = 0; i < 10; i++)
        controlled(pid, 5, 1);
    for (int i = 0; i < 10; i++)
        controlled(pid, 5, NAN);
    assert_near(controlled(pid, 5, 4), 10 * 4 * h, 1e-12);
    testbed_end(pid);
}

static double controlled_after(struct fl_block *pid, double set_point, double measurement, int64_t interval_ns)
{
    SET(pid, "set_point", double, set_point);
    SET(pid, "measurement", double, measurement);
    assert_int_equal(testbed_step_after(pid, interval_ns), FL_OK);
    return GET(pid, "out", double);
}

/* The integral grows and the derivative is by the time that passed. */
static void goes_by_time_in_late_steps(void **state)
{
    (void)state;
    struct fl_block *integral = testbed_block("pid", "ki", "5", "min", "-99", "max", "99", NULL);
    struct fl_block *derivative = testbed_block("pid", "kd", "3", "min", "-99", "max", "99", NULL);
    testbed_begin(integral);
    testbed_begin(derivative);
    controlled(integral, 2, 0);
    controlled(derivative, 0, 0);
    for (int i = 1; i <= 10; i++) {
        assert_near(controlled_after(integral, 2, 0, 35000000), 5 * 2 * (h + 0.035 * (i - 1)), 1e-12);
        assert_near(controlled_after(derivative, 0, 2 * 0.035 * i, 35000000), -6, 1e-9);
    }
    testbed_end(integral);
    testbed_end(derivative);
}

/* A step at once after another: nothing is divided by no time, and the one after both sees all of the change. */
static void its_derivative_takes_its_time(void **state)
{
    (void)state;
    struct fl_block *pid = testbed_block("pid", "kd", "3", "min", "-99", "max", "99", NULL);
    testbed_begin(pid);
    controlled(pid, 0, 0);
    assert_near(controlled(pid, 0, 2 * h), -6, 1e-9);
    assert_near(controlled_after(pid, 0, 2 * h + 0.001, 0), -6, 1e-9);
    assert_near(controlled_after(pid, 0, 2 * h + 0.002, 4999999), -6, 1e-9);
    assert_near(controlled_after(pid, 0, 2 * h + 0.04, 5000001), -3 * 0.04 / 0.01, 1e-9);
    testbed_end(pid);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("pid", "min", "1", "max", "0", NULL), "min 1 is above max 0"));
    assert_non_null(strstr(testbed_refusal("pid", "min", "0", "max", "1", "filter", "-1", NULL), "outside 0 to inf s"));
    assert_non_null(strstr(testbed_refusal("pid", "max", "1", NULL), "parameter min of pid is missing"));
    assert_non_null(strstr(testbed_refusal("pid", "min", "0", "max", "1", "anti_windup", "off", NULL),
                           "off is not one of clamping"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(proportional),
        cmocka_unit_test(integral),
        cmocka_unit_test(derivative),
        cmocka_unit_test(does_not_wind_up),
        cmocka_unit_test(back_calculation_finds_its_balance),
        cmocka_unit_test(turns_the_short_way),
        cmocka_unit_test(survives_what_is_not_finite),
        cmocka_unit_test(its_integral_stays_finite),
        cmocka_unit_test(continues_after_a_fault),
        cmocka_unit_test(goes_by_time_in_late_steps),
        cmocka_unit_test(its_derivative_takes_its_time),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
