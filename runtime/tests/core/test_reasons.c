/* Why a device is not good: each reason is logged once, and anew after the device was good for a while. */
#define _GNU_SOURCE
#include "said.h"

#include <flotilla/driver.h>

#define SECOND_NS INT64_C(1000000000)

static int step(struct fl_block *block)
{
    (void)block;
    return FL_OK;
}

FL_BLOCK(probe) = {.abi = FL_ABI, .name = "probe", .step = step};

static void tells_each_reason_once(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("probe", NULL);
    struct fl_reasons reasons = {0};
    struct said said = said_begin();
    for (int i = 0; i < 100; i++) {
        fl_reasons_log(&reasons, block, i, "a checksum is %s", "wrong");
        fl_reasons_log(&reasons, block, i, "fault %d", 7);
        fl_reasons_good(&reasons, i); /* frames between the wrong ones */
    }
    assert_int_equal(said_times(&said, "probe: a checksum is wrong\n"), 1);
    assert_int_equal(said_times(&said, "probe: fault 7\n"), 1);
    said_end(&said);
    testbed_end(block);
}

static void tells_it_anew_after_the_device_was_good(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("probe", NULL);
    struct fl_reasons reasons = {0};
    struct said said = said_begin();
    fl_reasons_log(&reasons, block, SECOND_NS, "fault");
    fl_reasons_good(&reasons, FL_REASONS_STEADY_S * SECOND_NS); /* a second too early */
    fl_reasons_log(&reasons, block, FL_REASONS_STEADY_S * SECOND_NS, "fault");
    assert_int_equal(said_times(&said, "fault"), 1);
    fl_reasons_log(&reasons, block, 3 * FL_REASONS_STEADY_S * SECOND_NS, "fault"); /* never good since */
    assert_int_equal(said_times(&said, "fault"), 1);
    fl_reasons_good(&reasons, 4 * FL_REASONS_STEADY_S * SECOND_NS);
    fl_reasons_log(&reasons, block, 4 * FL_REASONS_STEADY_S * SECOND_NS, "fault");
    assert_int_equal(said_times(&said, "fault"), 2);
    said_end(&said);
    testbed_end(block);
}

static void tells_no_more_than_so_many(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("probe", NULL);
    struct fl_reasons reasons = {0};
    struct said said = said_begin();
    char endless[2 * FL_REASON_TEXT];
    memset(endless, 'x', sizeof endless - 1);
    endless[sizeof endless - 1] = '\0';
    for (int i = 0; i < 1000; i++)
        fl_reasons_log(&reasons, block, i, "%d %s", i, endless);
    assert_int_equal(said_times(&said, "probe: "), FL_REASONS);
    said_end(&said);
    testbed_end(block);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(tells_each_reason_once),
        cmocka_unit_test(tells_it_anew_after_the_device_was_good),
        cmocka_unit_test(tells_no_more_than_so_many),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
