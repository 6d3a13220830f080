#include "testbed.h"

#include <math.h>

static struct fl_block *stop(const char *backward)
{
    struct fl_block *block = testbed_block("obstacle-stop", "curvatures", "-1,0,1", "deceleration", "0.5", "delay",
                                           "0.2", "margin", "0.1", "backward", backward, NULL);
    testbed_begin(block);
    SET(block, "flag", uint8_t, 1);
    return block;
}

static void see(struct fl_block *block, double right, double ahead, double left)
{
    double *clearance = testbed_input(block, "clearance");
    clearance[0] = right;
    clearance[1] = ahead;
    clearance[2] = left;
    SET(block, "sequence", uint32_t, *(uint32_t *)testbed_input(block, "sequence") + 1);
}

static double drive(struct fl_block *block, double v, double omega)
{
    SET(block, "v", double, v);
    SET(block, "omega", double, omega);
    assert_int_equal(testbed_step(block), FL_OK);
    return GET(block, "v", double);
}

/* From 0.4 m/s, 0.2·0.4 m pass before the brake and 0.4²/(2·0.5) m while it is on: 0.24 m, and 0.1 m are left. */
static void slows_before_what_it_sees(void **state)
{
    (void)state;
    struct fl_block *block = stop("0");
    see(block, 9, 0.34, 9);
    assert_near(drive(block, 1, 0), 0.4, 1e-12);
    assert_near(GET(block, "free", double), 0.24, 1e-12);
    assert_true(GET(block, "limited", uint8_t));
    assert_near(drive(block, 0.3, 0), 0.3, 0);
    assert_false(GET(block, "limited", uint8_t));
    see(block, 9, 0.1, 9);
    assert_near(drive(block, 1, 0.5), 0, 0);
    assert_near(GET(block, "omega", double), 0, 0);
    assert_near(drive(block, 0, 0.5), 0, 0);
    assert_near(GET(block, "omega", double), 0.5, 0); /* on the spot */
    testbed_end(block);
}

static void counts_what_it_has_gone_since_the_scan(void **state)
{
    (void)state;
    struct fl_block *block = stop("0");
    SET(block, "speed", double, 0.5);
    SET(block, "age", double, 0.1);
    see(block, 9, 0.34 + 0.05, 9);
    assert_near(drive(block, 1, 0), 0.4, 1e-12);
    for (int i = 1; i <= 10; i++) /* 5 mm each */
        drive(block, 1, 0);
    assert_near(GET(block, "free", double), 0.24 - 0.05, 1e-12);
    see(block, 9, 0.34 + 0.05, 9);
    assert_near(drive(block, 1, 0), 0.4, 1e-12);
    testbed_end(block);
}

static void looks_along_the_curve(void **state)
{
    (void)state;
    struct fl_block *block = stop("0");
    see(block, 9, 9, 0.34);
    assert_near(drive(block, 1, 0), 1, 0);         /* straight on, where there is a curve for it */
    assert_near(drive(block, 1, 0.5), 0.4, 1e-12); /* between two */
    assert_near(GET(block, "omega", double), 0.2, 1e-12);
    assert_near(drive(block, 1, 3), 0.4, 1e-12); /* beyond the last */
    assert_near(drive(block, 1, -1), 1, 0);
    SET(block, "speed", double, 0.1); /* it still turns left */
    SET(block, "rate", double, 0.1);
    assert_true(drive(block, 1, -1) < 0.4);
    testbed_end(block);
}

static void goes_back_blindly(void **state)
{
    (void)state;
    struct fl_block *block = stop("0.1");
    see(block, 0, 0, 0);
    assert_near(drive(block, -0.05, 0.3), -0.05, 0);
    assert_near(drive(block, -0.2, 0.3), -0.1, 0);
    assert_near(GET(block, "omega", double), 0.15, 1e-12);
    testbed_end(block);
    block = stop("0");
    see(block, 9, 9, 9);
    assert_near(drive(block, -0.2, 0.3), 0, 0);
    testbed_end(block);
}

static void stops_without_eyes(void **state)
{
    (void)state;
    struct fl_block *block = stop("1");
    see(block, 9, 9, 9);
    SET(block, "age", double, 0.31);
    assert_near(drive(block, 1, 1), 0, 0);
    assert_near(GET(block, "omega", double), 0, 0);
    assert_true(GET(block, "limited", uint8_t));
    SET(block, "age", double, NAN);
    assert_near(drive(block, 1, 1), 0, 0);
    SET(block, "age", double, 0);
    SET(block, "flag", uint8_t, 0);
    assert_near(drive(block, -1, 1), 0, 0);
    SET(block, "flag", uint8_t, 1);
    assert_near(drive(block, NAN, 1), 0, 0);
    assert_near(drive(block, 1, INFINITY), 0, 0);
    SET(block, "speed", double, NAN);
    assert_near(drive(block, 1, 1), 0, 0);
    SET(block, "speed", double, 0);
    SET(block, "rate", double, NAN);
    assert_near(drive(block, 1, 1), 0, 0);
    SET(block, "rate", double, 0);
    see(block, 9, NAN, NAN);
    assert_near(drive(block, 1, 1), 0, 0);
    see(block, 9, 9, 9);
    assert_near(drive(block, 1, 1), 1, 0);
    testbed_end(block);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(
        testbed_refusal("obstacle-stop", "deceleration", "1", "delay", "0", "margin", "0", "curvatures", "1,0", NULL),
        "curvatures: 1 does not increase to 0"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(slows_before_what_it_sees), cmocka_unit_test(counts_what_it_has_gone_since_the_scan),
        cmocka_unit_test(looks_along_the_curve),     cmocka_unit_test(goes_back_blindly),
        cmocka_unit_test(stops_without_eyes),        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
