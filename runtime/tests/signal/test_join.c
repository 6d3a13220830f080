#include "testbed.h"

static void joins(void **state)
{
    (void)state;
    struct fl_block *join = testbed_block("join", "inputs", "3", NULL);
    struct fl_block *flags = testbed_block("join", "type", "boolean", NULL);
    testbed_begin(join);
    testbed_begin(flags);
    assert_int_equal(join->out_ports[0].width, 3);
    assert_int_equal(join->out_ports[0].type, FL_DOUBLE);
    SET(join, "in0", double, 1.5);
    SET(join, "in1", double, -2);
    SET(join, "in2", double, 1e300);
    SET(flags, "in1", uint8_t, 1);
    assert_int_equal(testbed_step(join), FL_OK);
    assert_int_equal(testbed_step(flags), FL_OK);
    assert_memory_equal(testbed_output(join, "out"), ((const double[]){1.5, -2, 1e300}), 3 * sizeof(double));
    assert_int_equal(flags->out_ports[0].type, FL_BOOLEAN);
    assert_memory_equal(testbed_output(flags, "out"), ((const uint8_t[]){0, 1}), 2);
    testbed_end(join);
    testbed_end(flags);
}

/* The names of the choices stand for the types in their order. */
static void knows_all_types(void **state)
{
    (void)state;
    for (int type = 0; type < FL_TYPES; type++) {
        struct fl_block *join = testbed_block("join", "type", fl_type_name((enum fl_type)type), NULL);
        assert_int_equal(join->in_ports[1].type, type);
        testbed_end(join);
    }
    assert_non_null(strstr(testbed_refusal("join", "inputs", "65", NULL), "65 is outside 1 to 64"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(joins), cmocka_unit_test(knows_all_types)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
