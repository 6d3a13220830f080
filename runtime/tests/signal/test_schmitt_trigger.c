#include "testbed.h"

#include <math.h>

static void follow(struct fl_block *trigger, const double *in, const int *sign, size_t count)
{
    for (size_t i = 0; i < count; i++) {
        SET(trigger, "in", double, in[i]);
        assert_int_equal(testbed_step(trigger), FL_OK);
        assert_int_equal((int)GET(trigger, "sign", double), sign[i]);
        assert_int_equal(GET(trigger, "on", uint8_t), sign[i] != 0);
    }
}

static void has_hysteresis(void **state)
{
    (void)state;
    struct fl_block *trigger = testbed_block("schmitt-trigger", "on", "1", "off", "-0.5", NULL);
    const double in[] = {0, 0.99, 1, 0.2, -0.5, -0.51, 0.9, 5, -5, -100};
    const int sign[] = {0, 0, 1, 1, 1, 0, 0, 1, 0, 0};
    testbed_begin(trigger);
    follow(trigger, in, sign, sizeof in / sizeof in[0]);
    testbed_end(trigger);
}

/* The floating robot's: on at 10 mm, off at 40 % of it, for errors of either sign. */
static void has_two_sides(void **state)
{
    (void)state;
    struct fl_block *trigger =
        testbed_block("schmitt-trigger", "on", "0.010", "off", "0.004", "symmetric", "true", NULL);
    struct fl_block *other = testbed_block("schmitt-trigger", "on", "2", "off", "1", NULL);
    const double in[] = {0.009, 0.010, 0.005, -0.005, -0.009, -0.010, -0.0041, -0.0039, -0.02, 0.02, 0.001};
    const int sign[] = {0, 1, 1, 0, 0, -1, -1, 0, -1, 1, 0};
    testbed_begin(trigger);
    testbed_begin(other);
    follow(trigger, in, sign, sizeof in / sizeof in[0]);
    follow(other, (const double[]){2}, (const int[]){1}, 1);
    follow(trigger, (const double[]){0.009}, (const int[]){0}, 1);
    testbed_end(trigger);
    testbed_end(other);
}

static void is_off_without_a_number(void **state)
{
    (void)state;
    struct fl_block *trigger = testbed_block("schmitt-trigger", "on", "1", "off", "-1", NULL);
    const double in[] = {1, NAN, 0, INFINITY, -INFINITY};
    const int sign[] = {1, 0, 0, 1, 0};
    testbed_begin(trigger);
    follow(trigger, in, sign, sizeof in / sizeof in[0]);
    testbed_end(trigger);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("schmitt-trigger", "on", "1", "off", "2", NULL), "off 2 is above on 1"));
    assert_non_null(strstr(testbed_refusal("schmitt-trigger", "on", "1", "off", "-1", "symmetric", "true", NULL),
                           "symmetric needs on above zero and off not below it"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(has_hysteresis),
        cmocka_unit_test(has_two_sides),
        cmocka_unit_test(is_off_without_a_number),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
