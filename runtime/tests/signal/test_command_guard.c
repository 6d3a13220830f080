#include "testbed.h"

#include <math.h>

enum { LENGTH = 9 }; /* operator, sequence, and a byte that says which datagram it is */

static struct fl_block *guard(void)
{
    struct fl_block *block = testbed_block("command-guard", "length", "9", "apart", "1", "timeout", "0.3", NULL);
    testbed_begin(block);
    SET(block, "flag", uint8_t, 1);
    return block;
}

static void little(uint8_t *bytes, uint32_t word)
{
    for (int i = 0; i < 4; i++)
        bytes[i] = (uint8_t)(word >> 8 * i);
}

/* A step with a datagram. The flag. */
static bool hear(struct fl_block *block, uint32_t operator, uint32_t sequence, uint8_t payload)
{
    uint8_t *data = testbed_input(block, "data");
    little(data, operator);
    little(data + 4, sequence);
    data[LENGTH - 1] = payload;
    SET(block, "age", double, 0);
    SET(block, "sequence", uint32_t, *(uint32_t *)testbed_input(block, "sequence") + 1);
    assert_int_equal(testbed_step(block), FL_OK);
    return GET(block, "flag", uint8_t);
}

/* Steps without one. */
static void wait(struct fl_block *block, double seconds)
{
    for (int i = 0; i < (int)lround(seconds * 100); i++) {
        SET(block, "age", double, *(double *)testbed_input(block, "age") + 0.01);
        assert_int_equal(testbed_step(block), FL_OK);
    }
}

static int payload(struct fl_block *block)
{
    return ((const uint8_t *)testbed_output(block, "data"))[LENGTH - 1];
}

#define assert_says(block, flag_, operator_, other_, refused_)                                                         \
    do {                                                                                                               \
        assert_int_equal(GET(block, "flag", uint8_t), flag_);                                                          \
        assert_int_equal(GET(block, "operator", uint32_t), operator_);                                                 \
        assert_int_equal(GET(block, "other", uint32_t), other_);                                                       \
        assert_int_equal(GET(block, "conflict", uint8_t), (other_) != 0);                                              \
        assert_int_equal(GET(block, "refused", uint32_t), refused_);                                                   \
    } while (0)

/* One datagram may be anybody's rubbish: the second of the same sender passes. */
static void lets_the_operator_pass_who_speaks(void **state)
{
    (void)state;
    struct fl_block *block = guard();
    wait(block, 0.5);
    assert_says(block, 0, 0, 0, 0);
    assert_near(GET(block, "age", double), 0.5, 1e-9);
    assert_false(hear(block, 7, 1, 10));
    assert_says(block, 0, 0, 0, 0);
    assert_int_equal(payload(block), 0);
    wait(block, 0.09);
    assert_true(hear(block, 7, 2, 11));
    assert_says(block, 1, 7, 0, 0);
    assert_int_equal(payload(block), 11);
    assert_near(GET(block, "age", double), 0, 1e-9);
    testbed_end(block);
}

static void is_a_dead_mans_switch(void **state)
{
    (void)state;
    struct fl_block *block = guard();
    hear(block, 7, 1, 10);
    assert_true(hear(block, 7, 2, 11));
    wait(block, 0.3);
    assert_says(block, 1, 7, 0, 0);
    wait(block, 0.01);
    assert_says(block, 0, 7, 0, 0);
    assert_near(GET(block, "age", double), 0.31, 1e-9);
    assert_int_equal(payload(block), 11);
    assert_true(hear(block, 7, 3, 12));
    SET(block, "flag", uint8_t, 0); /* the receiver's */
    wait(block, 0.01);
    assert_says(block, 0, 7, 0, 0);
    SET(block, "flag", uint8_t, 1);
    wait(block, 2);
    assert_false(hear(block, 7, 4, 13)); /* it begins again, by two */
    assert_int_equal(payload(block), 12);
    assert_true(hear(block, 7, 5, 14));
    testbed_end(block);
}

/* Nobody's commands pass while two speak, and 1 s longer; then the first one's, who goes on. */
static void stops_while_two_command(void **state)
{
    (void)state;
    struct fl_block *block = guard();
    uint32_t sequence = 0;
    for (; sequence < 5; wait(block, 0.09))
        hear(block, 7, ++sequence, 1);
    assert_says(block, 1, 7, 0, 0);
    for (int i = 1; i <= 20; i++, wait(block, 0.08)) {
        hear(block, 7, ++sequence, 2);
        hear(block, 9, (uint32_t)i, 99);
        assert_says(block, 0, 7, 9, 0);
        assert_int_equal(payload(block), 2);
    }
    double silent = 0.09; /* since the other one spoke */
    for (; silent < 0.9; silent += 0.1, wait(block, 0.09)) {
        assert_false(hear(block, 7, ++sequence, 3));
        assert_says(block, 0, 7, 9, 0);
    }
    hear(block, 7, ++sequence, 4);
    wait(block, 0.1);
    assert_says(block, 1, 7, 0, 0);
    testbed_end(block);
}

/* The second one goes on. Seen from 1 s after the first one's last. */
static void passes_to_another_when_the_first_is_silent(void **state)
{
    (void)state;
    struct fl_block *block = guard();
    hear(block, 7, 1, 1);
    hear(block, 7, 2, 1);
    for (uint32_t i = 1; i <= 10; i++) {
        wait(block, 0.09);
        assert_false(hear(block, 9, i, (uint8_t)(100 + i)));
        assert_says(block, 0, 7, 9, 0);
    }
    wait(block, 0.09);
    assert_true(hear(block, 9, 11, 111));
    assert_says(block, 1, 9, 0, 0);
    assert_int_equal(payload(block), 111);
    testbed_end(block);
}

/* Two new ones at once, while nobody's commands pass. */
static void takes_neither_of_two_that_begin_at_once(void **state)
{
    (void)state;
    struct fl_block *block = guard();
    for (uint32_t i = 1; i <= 30; i++, wait(block, 0.08)) {
        assert_false(hear(block, 7, i, 1));
        assert_false(hear(block, 9, i, 2) || (i > 1 && !GET(block, "conflict", uint8_t)));
    }
    testbed_end(block);
}

static void refuses_what_is_repeated_or_overtaken(void **state)
{
    (void)state;
    struct fl_block *block = guard();
    hear(block, 7, 100, 1);
    assert_true(hear(block, 7, 102, 2));
    assert_true(hear(block, 7, 101, 3));
    assert_says(block, 1, 7, 0, 1);
    assert_int_equal(payload(block), 2);
    for (int i = 0; i < 50; i++) /* it does not keep the robot alive */
        hear(block, 7, 102, 4);
    assert_says(block, 0, 7, 0, 51);
    assert_int_equal(payload(block), 2);
    assert_true(hear(block, 7, 103, 5));
    assert_int_equal(payload(block), 5);
    testbed_end(block);
}

/* A recording of one who commanded before, while another one does: neither a command nor a conflict. */
static void refuses_a_recording_of_the_operator_before(void **state)
{
    (void)state;
    struct fl_block *block = guard();
    for (uint32_t i = 1; i <= 5; i++)
        hear(block, 7, i, 1);
    wait(block, 1.5);
    hear(block, 9, 1, 2);
    assert_true(hear(block, 9, 2, 3));
    for (uint32_t i = 1; i <= 5; i++) {
        assert_true(hear(block, 7, i, 4));
        assert_says(block, 1, 9, 0, i);
    }
    assert_int_equal(payload(block), 3);
    testbed_end(block);
}

static void counts_on_after_the_largest_number(void **state)
{
    (void)state;
    struct fl_block *block = guard();
    hear(block, 7, UINT32_MAX - 1, 1);
    hear(block, 7, UINT32_MAX, 2);
    assert_true(hear(block, 7, 0, 3));
    assert_true(hear(block, 7, 1, 4));
    assert_int_equal(payload(block), 4);
    hear(block, 7, UINT32_MAX, 5);
    assert_says(block, 1, 7, 0, 1);
    hear(block, 7, 1 + (UINT32_C(1) << 31), 6); /* half of all numbers ahead: it is behind */
    assert_says(block, 1, 7, 0, 2);
    hear(block, 7, UINT32_C(1) << 31, 7); /* the last one that is ahead */
    assert_int_equal(payload(block), 7);
    testbed_end(block);
}

/* Each datagram has another number: nothing of it passes, and it is a conflict with one who speaks. */
static void lets_no_rubbish_pass(void **state)
{
    (void)state;
    struct fl_block *block = guard();
    uint32_t noise = 12345;
    for (int i = 0; i < 100; i++, wait(block, 0.01)) {
        noise = noise * 1664525 + 1013904223;
        assert_false(hear(block, noise, noise >> 7, 66));
        assert_int_equal(GET(block, "operator", uint32_t), 0);
    }
    assert_int_equal(payload(block), 0);
    wait(block, 1.1);
    hear(block, 7, 1, 1);
    assert_true(hear(block, 7, 2, 2));
    for (uint32_t i = 0; i < 30; i++) { /* more than it can know: the one whose commands passed stays known */
        noise = noise * 1664525 + 1013904223;
        assert_false(hear(block, noise, 1, 66));
        assert_false(hear(block, 7, 3 + i, 3));
        assert_says(block, 0, 7, noise, 0);
    }
    for (uint32_t i = 1; i <= 20; i++)
        hear(block, noise + i, 1, 66);
    hear(block, 7, 3, 66);
    assert_says(block, 0, 7, noise + 20, 1);
    assert_int_equal(payload(block), 3);
    hear(block, 0, 1, 66);
    assert_int_equal(GET(block, "refused", uint32_t), 2);
    wait(block, 1.1);
    hear(block, 7, 40, 4);
    assert_true(hear(block, 7, 41, 5));
    testbed_end(block);
}

/* A queue that was full for a while, or a clock that went wrong. */
static void minds_the_age(void **state)
{
    (void)state;
    struct fl_block *block = guard();
    hear(block, 7, 1, 1);
    assert_true(hear(block, 7, 2, 2));
    static const double none[] = {NAN, -1, INFINITY, 1e9};
    for (uint32_t i = 0; i < 4; i++) {
        SET(block, "age", double, none[i]);
        SET(block, "sequence", uint32_t, 90 + i);
        ((uint8_t *)testbed_input(block, "data"))[4] = 200;
        assert_int_equal(testbed_step(block), FL_OK);
        assert_says(block, 1, 7, 0, i + 1);
    }
    SET(block, "age", double, 0.5); /* it waited in a queue */
    SET(block, "sequence", uint32_t, 99);
    assert_int_equal(testbed_step(block), FL_OK);
    assert_says(block, 0, 7, 0, 4);
    assert_near(GET(block, "age", double), 0.5, 1e-9);
    testbed_end(block);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("command-guard", "length", "7", NULL), "7 is outside 8 to 65507"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(lets_the_operator_pass_who_speaks),
        cmocka_unit_test(is_a_dead_mans_switch),
        cmocka_unit_test(stops_while_two_command),
        cmocka_unit_test(passes_to_another_when_the_first_is_silent),
        cmocka_unit_test(takes_neither_of_two_that_begin_at_once),
        cmocka_unit_test(refuses_what_is_repeated_or_overtaken),
        cmocka_unit_test(refuses_a_recording_of_the_operator_before),
        cmocka_unit_test(counts_on_after_the_largest_number),
        cmocka_unit_test(lets_no_rubbish_pass),
        cmocka_unit_test(minds_the_age),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
