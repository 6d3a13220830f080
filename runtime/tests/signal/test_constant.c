#include "testbed.h"

static void gives_its_list(void **state)
{
    (void)state;
    struct fl_block *constant = testbed_block("constant", "value", "1.5,-2,1e3", NULL);
    struct fl_block *other = testbed_block("constant", "value", "7", NULL);
    testbed_begin(constant);
    testbed_begin(other);
    assert_int_equal(constant->out_ports[0].width, 3);
    const double *out = testbed_output(constant, "out");
    for (int i = 0; i < 2; i++) { /* as of time zero, and after a step */
        assert_near(out[0], 1.5, 0);
        assert_near(out[1], -2, 0);
        assert_near(out[2], 1e3, 0);
        assert_near(GET(other, "out", double), 7, 0);
        assert_int_equal(testbed_step(constant), FL_OK);
    }
    testbed_end(constant);
    testbed_end(other);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("constant", NULL), "parameter value of constant is missing"));
    assert_non_null(strstr(testbed_refusal("constant", "value", "1,nan", NULL), "is not a list of numbers"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(gives_its_list), cmocka_unit_test(refuses)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
