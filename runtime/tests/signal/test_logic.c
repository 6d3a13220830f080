#include "testbed.h"

#include <math.h>

/* Each operation over all inputs of three flags, bit n of `truth` for the inputs' number n. */
static void combines(void **state)
{
    (void)state;
    static const struct {
        const char *operation;
        unsigned truth;
    } cases[] = {{"and", 0x80}, {"or", 0xfe}, {"xor", 0x96}, {"not", 0x01}};
    for (size_t c = 0; c < sizeof cases / sizeof cases[0]; c++) {
        struct fl_block *logic = testbed_block("logic", "operation", cases[c].operation, "inputs", "3", NULL);
        testbed_begin(logic);
        for (unsigned number = 0; number < 8; number++) {
            SET(logic, "in0", uint8_t, number & 1);
            SET(logic, "in1", uint8_t, number >> 1 & 1 ? 255 : 0); /* whatever is not 0 */
            SET(logic, "in2", uint8_t, number >> 2 & 1);
            assert_int_equal(testbed_step(logic), FL_OK);
            assert_int_equal(GET(logic, "out", uint8_t), cases[c].truth >> number & 1);
        }
        testbed_end(logic);
    }
}

static void selects(void **state)
{
    (void)state;
    struct fl_block *select = testbed_block("select", NULL);
    testbed_begin(select);
    SET(select, "then", double, 4);
    SET(select, "otherwise", double, NAN);
    SET(select, "condition", uint8_t, 1);
    assert_int_equal(testbed_step(select), FL_OK);
    assert_near(GET(select, "out", double), 4, 0);
    SET(select, "condition", uint8_t, 0);
    testbed_step(select);
    assert_true(isnan(GET(select, "out", double)));
    testbed_end(select);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("logic", "operation", "imply", NULL), "imply is not one of and|or|xor|not"));
    assert_non_null(strstr(testbed_refusal("logic", "inputs", "0", NULL), "0 is outside 1 to 32"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(combines), cmocka_unit_test(selects),
                                       cmocka_unit_test(refuses)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
