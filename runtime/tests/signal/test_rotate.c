#include "testbed.h"

#include <math.h>

static void turn(struct fl_block *rotate, double x, double y, double angle)
{
    SET(rotate, "x", double, x);
    SET(rotate, "y", double, y);
    SET(rotate, "angle", double, angle);
    assert_int_equal(testbed_step(rotate), FL_OK);
}

static void expect(struct fl_block *rotate, double x, double y)
{
    assert_near(GET(rotate, "x", double), x, 1e-12);
    assert_near(GET(rotate, "y", double), y, 1e-12);
}

/* A robot that looks along the world's y has the world's y ahead and the world's x to its right. */
static void turns_into_the_robots_axes(void **state)
{
    (void)state;
    struct fl_block *into = testbed_block("rotate", "unit", "deg", NULL);
    struct fl_block *back = testbed_block("rotate", "direction", "out-of", NULL);
    testbed_begin(into);
    testbed_begin(back);
    turn(into, 0, 3, 90);
    expect(into, 3, 0);
    turn(into, 2, 0, 90);
    expect(into, 0, -2);
    turn(into, 2, 0, -30);
    expect(into, sqrt(3), 1);
    turn(back, 1, 0, 1.5707963267948966);
    expect(back, 0, 1);
    testbed_end(into);
    testbed_end(back);
}

static void returns(void **state)
{
    (void)state;
    struct fl_block *into = testbed_block("rotate", NULL), *back = testbed_block("rotate", "direction", "out-of", NULL);
    testbed_begin(into);
    testbed_begin(back);
    for (int i = -50; i < 50; i++) {
        turn(into, 3, -4, 0.3 * i);
        assert_near(hypot(GET(into, "x", double), GET(into, "y", double)), 5, 1e-12);
        turn(back, GET(into, "x", double), GET(into, "y", double), 0.3 * i);
        expect(back, 3, -4);
    }
    turn(into, 1, 1, INFINITY);
    assert_true(isnan(GET(into, "x", double)));
    testbed_end(into);
    testbed_end(back);
    assert_non_null(strstr(testbed_refusal("rotate", "direction", "in", NULL), "in is not one of into|out-of"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(turns_into_the_robots_axes), cmocka_unit_test(returns)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
