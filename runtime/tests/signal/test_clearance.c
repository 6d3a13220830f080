#include "testbed.h"

#include <math.h>

static struct fl_block *scanner(const char *least_seen)
{
    /* Ahead, left, back, right; the robot has a radius of 0.3 m, and the scanner sits 0.1 m ahead. */
    struct fl_block *block =
        testbed_block("curve-clearance", "points", "4", "first", "0", "increment", "1.5707963267948966", "x", "0.1",
                      "radius", "0.3", "reach", "4", "least_seen", least_seen, "curvatures", "-1,0,1", NULL);
    testbed_begin(block);
    SET(block, "flag", uint8_t, 1);
    return block;
}

static const double *clearances(struct fl_block *block, double ahead, double left, double back, double right)
{
    double *ranges = testbed_input(block, "ranges");
    ranges[0] = ahead;
    ranges[1] = left;
    ranges[2] = back;
    ranges[3] = right;
    assert_int_equal(testbed_step(block), FL_OK);
    return testbed_output(block, "clearance");
}

static void goes_straight(void **state)
{
    (void)state;
    struct fl_block *block = scanner("0");
    assert_near(clearances(block, 2, NAN, NAN, NAN)[1], 1.8, 1e-12); /* 2.1 m from the axle, less the radius */
    assert_near(clearances(block, 9, NAN, NAN, NAN)[1], 4, 0);
    /* Aside by 0.18 m the disc is touched 0.24 m before its end; by 0.31 m it passes. What is behind is left there. */
    assert_near(clearances(block, NAN, 0.31, NAN, 0.31)[1], 4, 0);
    assert_near(clearances(block, NAN, NAN, 1, NAN)[1], 4, 0);
    testbed_end(block);
    block = testbed_block("curve-clearance", "points", "1", "first", "0.09966865249116204", "increment", "0", "radius",
                          "0.3", "least_seen", "0", NULL); /* atan(0.1) */
    testbed_begin(block);
    SET(block, "flag", uint8_t, 1);
    SET(block, "ranges", double, sqrt(1.8 * 1.8 + 0.18 * 0.18));
    assert_int_equal(testbed_step(block), FL_OK);
    assert_near(GET(block, "clearance", double), 1.8 - 0.24, 1e-12);
    testbed_end(block);
}

/* Left and right on a circle of 1 m. A point there, 1 m to the left of the scanner, lies near its centre and is never
 * touched; one of 2 m is touched a good way around: cos A = (1 + d² − 0.09)/(2 d), d = |(0.1, 1)|. */
static void goes_around(void **state)
{
    (void)state;
    struct fl_block *block = scanner("0");
    assert_near(clearances(block, NAN, 1, NAN, NAN)[2], 4, 0);
    double distance = hypot(0.1, 1), expected = atan2(0.1, -1) - acos((0.91 + distance * distance) / (2 * distance));
    const double *found = clearances(block, NAN, 2, NAN, NAN);
    assert_near(found[2], expected, 1e-12);
    assert_near(found[0], 4, 0);
    found = clearances(block, NAN, NAN, NAN, 2); /* the same to the right */
    assert_near(found[0], expected, 1e-12);
    assert_near(found[2], 4, 0);
    /* Behind by 1 m and less: only a full circle leads there, which is longer than `reach`. */
    assert_near(clearances(block, NAN, NAN, 0.5, NAN)[2], 4, 0);
    testbed_end(block);
}

static void stands_against_something(void **state)
{
    (void)state;
    struct fl_block *block = scanner("0");
    const double *found = clearances(block, 0.15, NAN, NAN, NAN);
    for (int i = 0; i < 3; i++)
        assert_near(found[i], 0, 0);
    found = clearances(block, NAN, NAN, 0.3, NAN);
    for (int i = 0; i < 3; i++)
        assert_near(found[i], 4, 0); /* behind */
    testbed_end(block);
}

/* As REP 117 has it, and the block urg: −∞ is too near, +∞ is nothing. Seen to fail: the clearance was 4 m. */
static void stops_for_what_is_too_near(void **state)
{
    (void)state;
    struct fl_block *block = scanner("0.5");
    for (int direction = 0; direction < 4;
         direction++) { /* the scanner is ahead of the axle, and so is all around it */
        double ranges[] = {3, 3, 3, 3};
        ranges[direction] = -INFINITY;
        const double *found = clearances(block, ranges[0], ranges[1], ranges[2], ranges[3]);
        for (int i = 0; i < 3; i++)
            assert_near(found[i], 0, 0);
        assert_true(GET(block, "flag", uint8_t));
    }
    assert_near(clearances(block, INFINITY, NAN, 3, 3)[1], 4, 0);
    testbed_end(block);
    block = testbed_block("curve-clearance", "points", "2", "first", "0", "increment", "3.141592653589793", "radius",
                          "0.3", "reach", "4", NULL);
    testbed_begin(block);
    SET(block, "flag", uint8_t, 1);
    double *ranges = testbed_input(block, "ranges");
    ranges[0] = -INFINITY;
    ranges[1] = 3;
    assert_int_equal(testbed_step(block), FL_OK);
    assert_near(GET(block, "clearance", double), 0, 0);
    ranges[0] = 3;
    ranges[1] = -INFINITY; /* behind */
    assert_int_equal(testbed_step(block), FL_OK);
    assert_near(GET(block, "clearance", double), 2.7, 1e-12);
    testbed_end(block);
}

static void says_when_it_sees_nothing(void **state)
{
    (void)state;
    struct fl_block *block = scanner("0.5");
    assert_near(GET(block, "clearance", double), 0, 0);
    assert_near(clearances(block, 2, 3, NAN, INFINITY)[1], 1.8, 1e-12);
    assert_true(GET(block, "flag", uint8_t));
    assert_near(clearances(block, 2, NAN, NAN, INFINITY)[1], 0, 0);
    assert_false(GET(block, "flag", uint8_t));
    SET(block, "flag", uint8_t, 0);
    assert_near(clearances(block, 2, 2, 2, 2)[1], 0, 0);
    assert_false(GET(block, "flag", uint8_t));
    testbed_end(block);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("curve-clearance", "points", "1", "first", "0", "increment", "0", "radius",
                                           "1", "curvatures", "0,1,1", NULL),
                           "curvatures: 1 does not increase to 1"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(goes_straight),
        cmocka_unit_test(goes_around),
        cmocka_unit_test(stands_against_something),
        cmocka_unit_test(stops_for_what_is_too_near),
        cmocka_unit_test(says_when_it_sees_nothing),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
