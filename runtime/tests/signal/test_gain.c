#include "testbed.h"

static void multiplies(void **state)
{
    (void)state;
    struct fl_block *gain = testbed_block("gain", "factor", "-2.5", NULL);
    testbed_begin(gain);
    SET(gain, "in", double, 4);
    assert_int_equal(testbed_step(gain), FL_OK);
    assert_near(GET(gain, "out", double), -10, 0);
    testbed_end(gain);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("gain", "factor", "two", NULL), "parameter factor: two is not a number"));
    assert_non_null(strstr(testbed_refusal("gain", "facto", "2", NULL), "gain has no parameter facto; it has factor"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(multiplies), cmocka_unit_test(refuses)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
