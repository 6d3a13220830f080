#include "testbed.h"

#include <math.h>

/* As in a task: the reader of a delayed input runs first, so that `in` is what was written a step before. */
static void delays_by_a_step(void **state)
{
    (void)state;
    struct fl_block *delay = testbed_block("delay", "initial", "-4", NULL);
    struct fl_block *wide = testbed_block("delay", "type", "int16", "width", "2", "initial", "-300", NULL);
    testbed_begin(delay);
    testbed_begin(wide);
    assert_true(delay->in_ports[0].flags & FL_DELAYED);
    assert_near(GET(delay, "out", double), -4, 0);
    SET(delay, "in", double, 77); /* what the writer had as of time zero: no step's value */
    assert_int_equal(testbed_step(delay), FL_OK);
    assert_near(GET(delay, "out", double), -4, 0);
    for (int i = 0; i < 5; i++) {
        SET(delay, "in", double, i); /* of step i */
        testbed_step(delay);         /* step i + 1 */
        assert_near(GET(delay, "out", double), i, 0);
    }
    SET(delay, "in", double, NAN);
    testbed_step(delay);
    assert_true(isnan(GET(delay, "out", double)));
    const int16_t *out = testbed_output(wide, "out");
    assert_int_equal(out[0], -300);
    assert_int_equal(out[1], -300);
    testbed_step(wide);
    memcpy(testbed_input(wide, "in"), (const int16_t[]){5, -6}, 4);
    testbed_step(wide);
    assert_int_equal(out[0], 5);
    assert_int_equal(out[1], -6);
    testbed_end(delay);
    testbed_end(wide);
}

#define EXPECT_INITIAL(name, text, c_type, expected)                                                                   \
    do {                                                                                                               \
        struct fl_block *block = testbed_block("delay", "type", name, "initial", text, NULL);                          \
        testbed_begin(block);                                                                                          \
        assert_true(GET(block, "out", c_type) == (expected));                                                          \
        testbed_end(block);                                                                                            \
    } while (0)

static void begins_with_any_type(void **state)
{
    (void)state;
    EXPECT_INITIAL("boolean", "1", uint8_t, 1);
    EXPECT_INITIAL("int8", "-128", int8_t, -128);
    EXPECT_INITIAL("uint8", "255", uint8_t, 255);
    EXPECT_INITIAL("int16", "-32768", int16_t, -32768);
    EXPECT_INITIAL("uint16", "65535", uint16_t, 65535);
    EXPECT_INITIAL("int32", "-2147483648", int32_t, INT32_MIN);
    EXPECT_INITIAL("uint32", "4294967295", uint32_t, UINT32_MAX);
    EXPECT_INITIAL("int64", "-9223372036854775808", int64_t, INT64_MIN);
    EXPECT_INITIAL("uint64", "9223372036854775808", uint64_t, UINT64_C(1) << 63);
    EXPECT_INITIAL("single", "0.1", float, 0.1f);
    EXPECT_INITIAL("double", "0.1", double, 0.1);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(
        strstr(testbed_refusal("delay", "type", "uint8", "initial", "256", NULL), "256 does not fit uint8"));
    assert_non_null(strstr(testbed_refusal("delay", "type", "int8", "initial", "0.5", NULL), "0.5 does not fit int8"));
    assert_non_null(strstr(testbed_refusal("delay", "type", "uint8", "initial", "-1", NULL), "-1 does not fit"));
    assert_non_null(strstr(testbed_refusal("delay", "type", "single", "initial", "1e39", NULL), "does not fit single"));
    assert_non_null(strstr(testbed_refusal("delay", "type", "int8", "initial", "-129", NULL), "-129 does not fit"));
    assert_non_null(strstr(testbed_refusal("delay", "type", "float", NULL), "float is not one of"));
}

/* Of a constant c: n h c after n steps; of the step's number: the sum of all before. */
static void integrates(void **state)
{
    (void)state;
    struct fl_block *integrator = testbed_block("integrator", "initial", "2", NULL);
    struct fl_block *other = testbed_block("integrator", NULL);
    testbed_begin(integrator);
    testbed_begin(other);
    for (int i = 0; i <= 100; i++) {
        SET(integrator, "in", double, 3);
        SET(other, "in", double, i - 1); /* of the step before */
        testbed_step(integrator);
        testbed_step(other);
        assert_near(GET(integrator, "out", double), 2 + 3 * 0.01 * i, 1e-12);
        assert_near(GET(other, "out", double), 0.01 * i * (i - 1) / 2, 1e-12);
    }
    SET(integrator, "in", double, NAN);
    testbed_step(integrator);
    SET(integrator, "in", double, INFINITY);
    testbed_step(integrator);
    assert_near(GET(integrator, "out", double), 5, 1e-12);
    SET(integrator, "in", double, 3);
    SET(integrator, "reset", uint8_t, 1);
    testbed_step(integrator);
    assert_near(GET(integrator, "out", double), 2, 0);
    SET(integrator, "reset", uint8_t, 0);
    testbed_step(integrator);
    assert_near(GET(integrator, "out", double), 2.03, 1e-12);
    testbed_end(integrator);
    testbed_end(other);
}

/* Also where steps come late, early or at once; after a long stop it goes on with ten periods. */
static void integrates_time(void **state)
{
    (void)state;
    static const struct {
        int64_t interval_ns;
        double grown;
    } steps[] = {{10000000, 0.01}, {35000000, 0.035}, {2500000, 0.0025}, {0, 0},
                 {-1000, 0},       {100000000, 0.1},  {100000001, 0.1},  {INT64_C(3600000000000), 0.1}};
    struct fl_block *integrator = testbed_block("integrator", NULL);
    double expected = 0;
    testbed_begin(integrator);
    SET(integrator, "in", double, 1);
    testbed_step_after(integrator, INT64_C(3600000000000)); /* nothing came before the first */
    assert_near(GET(integrator, "out", double), 0, 0);
    for (size_t i = 0; i < sizeof steps / sizeof steps[0]; i++) {
        testbed_step_after(integrator, steps[i].interval_ns);
        expected += steps[i].grown;
        assert_near(GET(integrator, "out", double), expected, 1e-12);
    }
    testbed_end(integrator);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(delays_by_a_step), cmocka_unit_test(begins_with_any_type), cmocka_unit_test(refuses),
        cmocka_unit_test(integrates),       cmocka_unit_test(integrates_time),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
