#include "testbed.h"

#include <math.h>

static double total(struct fl_block *sum, double a, double b, double c)
{
    SET(sum, "in0", double, a);
    SET(sum, "in1", double, b);
    SET(sum, "in2", double, c);
    assert_int_equal(testbed_step(sum), FL_OK);
    return GET(sum, "out", double);
}

static void adds_with_signs(void **state)
{
    (void)state;
    struct fl_block *sum = testbed_block("sum", "signs", "++-", NULL), *other = testbed_block("sum", NULL);
    testbed_begin(sum);
    testbed_begin(other);
    assert_int_equal(sum->in_count, 3);
    assert_int_equal(other->in_count, 2);
    assert_near(total(sum, 1, 20, 300), -279, 0);
    assert_true(isnan(total(sum, 1, NAN, 300)));
    assert_near(total(sum, 0.5, 0.25, 0.125), 0.625, 0); /* nothing stays of the one before */
    SET(other, "in0", double, 2);
    SET(other, "in1", double, 3);
    testbed_step(other);
    assert_near(GET(other, "out", double), 5, 0);
    assert_near(GET(sum, "out", double), 0.625, 0);
    testbed_end(sum);
    testbed_end(other);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("sum", "signs", "+2", NULL), "signs: \"+2\" is not 1 to 32 of + and -"));
    assert_non_null(strstr(testbed_refusal("sum", "signs", "", NULL), "signs: \"\" is not 1"));
    assert_non_null(
        strstr(testbed_refusal("sum", "signs", "+++++++++++++++++++++++++++++++++", NULL), "is not 1 to 32"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(adds_with_signs), cmocka_unit_test(refuses)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
