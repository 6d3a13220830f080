#include "testbed.h"

#include <flotilla/failover.h>

static const int64_t MS = 1000 * 1000;

/* Messages in order of arrival, at a time-out of 30 ms: who is listened to. */
static void one_is_listened_to(void **state)
{
    (void)state;
    static const struct {
        int64_t at_ms;
        size_t rank;
        bool taken;
    } messages[] = {
        {0, 1, false},                                                   /* the first may still come */
        {10, 0, true},  {11, 1, false},  {20, 0, true},                  /* and then dies */
        {21, 1, false}, {31, 1, false},  {41, 1, false}, {50, 1, false}, /* not yet for longer than the time-out */
        {51, 1, true},  {52, 2, false},  {61, 1, true},  {65, 0, true},  /* it is back, and has it at once */
        {71, 1, false}, {75, 0, true},   {106, 2, true},                 /* the second was silent for longer too */
        {107, 1, true}, {108, 2, false},
    };
    struct fl_failover failover;
    fl_failover_begin(&failover, 0);
    for (size_t i = 0; i < sizeof messages / sizeof messages[0]; i++) {
        bool taken = fl_failover_takes(&failover, messages[i].rank, messages[i].at_ms * MS, 0.03);
        if (taken != messages[i].taken)
            fail_msg("message %zu", i);
    }
}

/* Also where they arrive at one time, as stamps are cut after the clock was set. */
static void all_are_listened_to(void **state)
{
    (void)state;
    struct fl_failover failover;
    fl_failover_begin(&failover, 0);
    for (size_t i = 0; i < 8; i++)
        assert_true(fl_failover_takes(&failover, i % FL_SENDERS, 10 * MS, 0));
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(one_is_listened_to), cmocka_unit_test(all_are_listened_to)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
