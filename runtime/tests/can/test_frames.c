#define _GNU_SOURCE
#include "core/service.h"
#include "seccomp.h"
#include "testbed.h"

#include "hub.h"

#include <flotilla/block.h>
#include <linux/can/error.h>
#include <sched.h>

static struct can_frame frame_of(canid_t id, uint8_t length, const char *data)
{
    struct can_frame frame = {.can_id = id};
    frame.len = length;
    memcpy(frame.data, data, length);
    return frame;
}

static void put(canid_t id, uint8_t length, const char *data)
{
    struct can_frame frame = frame_of(id, length, data);
    hub_put(&frame);
}

static struct fl_block *receiver(const char *id, const char *mask, const char *extended)
{
    struct can_frame none;
    struct fl_block *block =
        testbed_block("can-receive", "id", id, "mask", mask, "extended", extended, "timeout", "30", NULL);
    testbed_begin(block);
    assert_false(hub_take(&none)); /* it is known to the hub now */
    return block;
}

static void receives_the_newest(void **state)
{
    (void)state;
    hub_open();
    struct fl_block *block = receiver("0x123", "0x7FF", "false");
    assert_int_equal(testbed_step(block), FL_OK);
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    assert_int_equal(GET(block, "sequence", uint32_t), 0);
    put(0x123, 8, "abcdefgh");
    put(0x123, 3, "xyz");
    block->release_ns = fl_now_ns() + 1000000000; /* well after the arrival, however slow the computer is */
    assert_int_equal(testbed_step(block), FL_OK);
    assert_memory_equal(testbed_output(block, "data"), "xyz\0\0\0\0\0", 8);
    assert_int_equal(GET(block, "length", uint8_t), 3);
    assert_int_equal(GET(block, "id", uint32_t), 0x123);
    assert_int_equal(GET(block, "flag", uint8_t), 1);
    assert_int_equal(GET(block, "sequence", uint32_t), 2);
    double age = GET(block, "age", double);
    assert_true(age > 0 && age < 2);
    assert_int_equal(testbed_step(block), FL_OK); /* nothing new: it ages by a period */
    assert_int_equal(testbed_step(block), FL_OK);
    assert_near(GET(block, "age", double), age + 0.02, 1e-9);
    testbed_end(block);
    hub_close();
}

/* Frames at 1 kHz, and steps of 300 ms. Seen to fail: a step gave frame 256 of 300. */
static void gives_the_newest_of_many(void **state)
{
    (void)state;
    enum { STEPS = 5, MANY = 300 };
    hub_open();
    struct fl_block *block = receiver("0x123", "0x7FF", "false");
    uint32_t sent = 0, received;
    for (int step = 0; step < STEPS; step++) {
        for (int i = 0; i < MANY; i++) {
            char data[sizeof sent];
            memcpy(data, &(uint32_t){++sent}, sizeof data);
            put(0x123, sizeof data, data);
        }
        assert_int_equal(testbed_step(block), FL_OK);
        memcpy(&received, testbed_output(block, "data"), sizeof received);
        assert_int_equal(received, sent);
    }
    testbed_end(block);
    hub_close();
}

/* The same for a drive, at whose SYNC another computer sends. Seen to fail: the block gave code 64 of 100. */
static void gives_the_newest_of_a_drive(void **state)
{
    (void)state;
    enum { MANY = 100 };
    struct can_frame none;
    hub_open();
    struct fl_block *block = testbed_block("epos2", "node", "5", "mode", "velocity", NULL);
    testbed_begin(block);
    assert_false(hub_take(&none)); /* it is known to the hub now */
    for (char code = 1; code <= MANY; code++)
        put(0x085, 8, (char[]){code, 0, 0, 0, 0, 0, 0, 0}); /* EMCY */
    assert_int_equal(testbed_step(block), FL_OK);
    assert_int_equal(GET(block, "error", uint16_t), MANY);
    testbed_end(block);
    hub_close();
}

/* The stamp is of the arrival in the kernel, not of the step that fetched the frame. Only the kernel knows when it has
 * begun to stamp after a socket has asked for it; until then it gives the time of the fetch. */
static void ages_from_the_kernels_stamp(void **state)
{
    (void)state;
    enum { ATTEMPTS = 1000 };
    double age = 0;
    hub_open();
    struct fl_block *block = receiver("0x123", "0x7FF", "false");
    for (int attempt = 0; attempt < ATTEMPTS && age < 0.005; attempt++) {
        put(0x123, 1, "a");
        int64_t put_ns = fl_now_ns();
        while (fl_now_ns() - put_ns < 5000000)
            ;
        block->release_ns = fl_now_ns() - block->period_ns;
        assert_int_equal(testbed_step(block), FL_OK);
        age = GET(block, "age", double);
    }
    assert_true(age >= 0.005);
    testbed_end(block);
    hub_close();
}

static void goes_bad_with_age(void **state)
{
    (void)state;
    struct can_frame none;
    hub_open();
    struct fl_block *block = testbed_block("can-receive", "id", "1", "timeout", "0.1", NULL);
    testbed_begin(block);
    assert_false(hub_take(&none));
    put(1, 1, "a");
    block->release_ns = fl_now_ns();
    for (int step = 0; step < 20; step++) {
        assert_int_equal(testbed_step(block), FL_OK);
        assert_int_equal(GET(block, "flag", uint8_t), GET(block, "age", double) <= 0.1);
    }
    assert_true(GET(block, "age", double) > 0.1);
    assert_int_equal(GET(block, "sequence", uint32_t), 1);
    testbed_end(block);
    hub_close();
}

static void filters(void **state)
{
    (void)state;
    hub_open();
    struct fl_block *standard = receiver("0x120", "0x7F0", "false"),
                    *extended = receiver("0x18DAF110", "0x1FFFFFFF", "true");
    put(0x128, 1, "m");
    put(0x130, 1, "n");                /* outside the mask */
    put(0x120 | CAN_EFF_FLAG, 1, "e"); /* of the other format */
    put(0x120 | CAN_RTR_FLAG, 0, "");  /* a request, no data */
    put(0x18DAF110 | CAN_EFF_FLAG, 2, "xt");
    assert_int_equal(testbed_step(standard), FL_OK);
    assert_int_equal(GET(standard, "sequence", uint32_t), 1);
    assert_int_equal(GET(standard, "id", uint32_t), 0x128);
    assert_int_equal(testbed_step(extended), FL_OK);
    assert_int_equal(GET(extended, "sequence", uint32_t), 1);
    assert_int_equal(GET(extended, "id", uint32_t), 0x18DAF110);
    testbed_end(standard);
    testbed_end(extended);
    hub_close();
}

static void bus_off_is_no_good(void **state)
{
    (void)state;
    hub_open();
    struct fl_block *block = receiver("5", "0x7FF", "false");
    put(5, 1, "a");
    assert_int_equal(testbed_step(block), FL_OK);
    assert_int_equal(GET(block, "flag", uint8_t), 1);
    put(CAN_ERR_FLAG | CAN_ERR_BUSOFF, 8, "\0\0\0\0\0\0\0\0");
    assert_int_equal(testbed_step(block), FL_OK);
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    put(CAN_ERR_FLAG | CAN_ERR_RESTARTED, 8, "\0\0\0\0\0\0\0\0");
    assert_int_equal(testbed_step(block), FL_OK);
    assert_int_equal(GET(block, "flag", uint8_t), 0); /* the frame is of before */
    put(5, 1, "b");
    assert_int_equal(testbed_step(block), FL_OK);
    assert_int_equal(GET(block, "flag", uint8_t), 1);
    put(CAN_ERR_FLAG | CAN_ERR_BUSOFF, 8, "\0\0\0\0\0\0\0\0");
    put(5, 1, "c"); /* the bus is alive again, said or not */
    assert_int_equal(testbed_step(block), FL_OK);
    assert_int_equal(GET(block, "flag", uint8_t), 1);
    assert_int_equal(GET(block, "sequence", uint32_t), 3);
    testbed_end(block);
    hub_close();
}

static void sends(void **state)
{
    (void)state;
    struct can_frame frame;
    hub_open();
    struct fl_block *block = testbed_block("can-send", "id", "0x18DAF110", "extended", "true", "length", "3", NULL);
    testbed_begin(block);
    memcpy(testbed_input(block, "data"), "abc", 3);
    assert_int_equal(testbed_step(block), FL_OK);
    assert_true(hub_take(&frame));
    assert_int_equal(frame.can_id, 0x18DAF110 | CAN_EFF_FLAG);
    assert_int_equal(frame.len, 3);
    assert_memory_equal(frame.data, "abc\0\0\0\0\0", 8);
    assert_int_equal(GET(block, "flag", uint8_t), 1);
    assert_int_equal(GET(block, "sent", uint32_t), 1);
    testbed_end(block);
    assert_false(hub_take(&frame)); /* no reset was asked for */
    hub_close();
}

static void resets_what_is_old(void **state)
{
    (void)state;
    struct can_frame frame;
    hub_open();
    struct fl_block *block =
        testbed_block("can-send", "id", "0x77", "length", "2", "reset", "00fF", "timeout", "0.1", NULL);
    testbed_begin(block);
    memcpy(testbed_input(block, "data"), "ab", 2);
    SET(block, "age", double, 0.1);
    assert_int_equal(testbed_step(block), FL_OK);
    assert_true(hub_take(&frame));
    assert_memory_equal(frame.data, "ab", 2);
    SET(block, "age", double, 0.11);
    assert_int_equal(testbed_step(block), FL_OK);
    assert_true(hub_take(&frame));
    assert_memory_equal(frame.data, "\x00\xFF", 2);
    block->type->safe(block);
    assert_true(hub_take(&frame));
    assert_memory_equal(frame.data, "\x00\xFF", 2);
    testbed_end(block);
    assert_true(hub_take(&frame));
    assert_int_equal(frame.can_id, 0x77);
    assert_int_equal(frame.len, 2);
    assert_memory_equal(frame.data, "\x00\xFF", 2);
    hub_close();
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("can-receive", "id", "0x800", NULL), "more than 11 bits: set `extended`"));
    assert_non_null(strstr(testbed_refusal("epos2", "node", "127", "mode", "current", NULL), "both 127"));
    /* The testbed's period is 10 ms. */
    assert_non_null(strstr(testbed_refusal("epos2", "node", "1", "mode", "current", "heartbeat", "0.039", NULL),
                           "shorter than 4 periods"));
    assert_non_null(strstr(testbed_refusal("can-send", "id", "0x800", NULL), "more than 11 bits: set `extended`"));
    assert_non_null(strstr(testbed_refusal("can-send", "id", "1", "reset", "00", NULL), "is not 8 bytes"));
    assert_non_null(
        strstr(testbed_refusal("can-send", "id", "1", "length", "1", "reset", "0g", NULL), "is not 1 bytes"));
    assert_non_null(
        strstr(testbed_refusal("can-send", "id", "1", "length", "1", "reset", "0", NULL), "is not 1 bytes"));
}

/* Until a step makes the flag so, with a new frame for each. What is awaited is the thread's: it looks ten times a
 * second. */
static void step_until(struct fl_block *block, bool flag)
{
    const int64_t patience_ns = INT64_C(30000000000);
    for (int64_t from_ns = fl_now_ns(); GET(block, "flag", bool) != flag;) {
        assert_true(fl_now_ns() - from_ns < patience_ns);
        put(5, 1, "a");
        assert_int_equal(testbed_step(block), FL_OK);
        block->release_ns = fl_now_ns();
        sched_yield();
    }
}

static void sends_when_the_interface_comes(void **state)
{
    (void)state;
    struct can_frame frame;
    hub_open();
    hub_link("");
    struct fl_block *block = testbed_block("can-send", "id", "5", "length", "1", NULL);
    testbed_begin(block);
    for (int i = 0; i < 3; i++)
        assert_int_equal(testbed_step(block), FL_OK);
    assert_int_equal(GET(block, "flag", bool), 0);
    assert_int_equal(GET(block, "sent", uint32_t), 0);
    block->type->safe(block);
    hub_link("7 down");
    hub_await();
    assert_int_equal(testbed_step(block), FL_OK);
    assert_int_equal(GET(block, "flag", bool), 0);
    hub_link("7 up");
    step_until(block, 1);
    assert_true(hub_take(&frame));
    assert_int_equal(frame.can_id, 5);
    testbed_end(block);
    hub_close();
}

static void receives_again_after_unplugging(void **state)
{
    (void)state;
    static const char *const gone[] = {"", "7 down", ""}, *const back[] = {"7 up", "7 up", "8 up"};
    struct can_frame none;
    hub_open();
    hub_link("");
    struct fl_block *block = testbed_block("can-receive", "id", "5", "timeout", "3600", NULL);
    testbed_begin(block);
    for (size_t i = 0; i < 3; i++) {
        hub_link(gone[i]);
        assert_int_equal(testbed_step(block), FL_OK);
        assert_int_equal(GET(block, "flag", bool), 0); /* however new the last frame is */
        hub_link(back[i]);
        if (i != 1)
            hub_await();
        assert_false(hub_take(&none));
        step_until(block, 1);
    }
    testbed_end(block);
    hub_close();
}

static void bus_off_ends_with_the_interface(void **state)
{
    (void)state;
    struct can_frame frame;
    hub_open();
    hub_link("7 up");
    struct fl_block *block = testbed_block("can-send", "id", "5", "length", "1", NULL);
    testbed_begin(block);
    step_until(block, 1);
    assert_true(hub_take(&frame));
    put(CAN_ERR_FLAG | CAN_ERR_BUSOFF, 8, "\0\0\0\0\0\0\0\0");
    assert_int_equal(testbed_step(block), FL_OK);
    assert_int_equal(GET(block, "flag", bool), 0);
    hub_link("7 down");
    assert_int_equal(testbed_step(block), FL_OK);
    hub_link("7 up");
    step_until(block, 1);
    testbed_end(block);
    hub_close();
}

/* Unplugged and plugged in: the drive is begun anew, by a reset of its communication. */
static void a_drive_is_begun_anew_with_its_interface(void **state)
{
    (void)state;
    struct can_frame frame;
    hub_open();
    hub_link("");
    struct fl_block *block = testbed_block("epos2", "node", "5", "mode", "velocity", NULL);
    testbed_begin(block);
    for (unsigned index = 7; index < 10; index++) {
        char up[16];
        snprintf(up, sizeof up, "%u up", index);
        assert_int_equal(testbed_step(block), FL_OK);
        while (hub_take(&frame))
            ;
        hub_link(up);
        hub_await();
        do { /* it sends from the step on in which it is known to be up */
            assert_int_equal(testbed_step(block), FL_OK);
        } while (!hub_take(&frame));
        if (frame.can_id != 0)
            assert_true(hub_take(&frame));
        assert_int_equal(frame.can_id, 0);
        assert_memory_equal(frame.data, "\x82\x05", 2);
        hub_link("");
    }
    testbed_end(block);
    hub_close();
}

/* Until the data were those of the reset frame; one without such a frame has no state to wait in. */
static void waits_for_a_command_that_is_off(void **state)
{
    (void)state;
    struct can_frame frame;
    hub_open();
    static const char *const data[] = {"a", "b", "\xFF", "a"}, *const sent[] = {"\xFF", "\xFF", "\xFF", "a"};
    struct fl_block *block = testbed_block("can-send", "id", "5", "length", "1", "reset", "ff", "timeout", "0.1", NULL);
    block->service->wait = FL_WAIT_BEGUN;
    testbed_begin(block);
    for (size_t i = 0; i < 4; i++) {
        memcpy(testbed_input(block, "data"), data[i], 1);
        assert_int_equal(testbed_step(block), FL_OK);
        assert_true(hub_take(&frame));
        assert_memory_equal(frame.data, sent[i], 1);
    }
    testbed_end(block);
    while (hub_take(&frame))
        ;
    block = testbed_block("can-send", "id", "5", "length", "1", NULL);
    block->service->wait = FL_WAIT_BEGUN;
    testbed_begin(block);
    memcpy(testbed_input(block, "data"), "a", 1);
    assert_int_equal(testbed_step(block), FL_OK);
    assert_true(hub_take(&frame));
    assert_memory_equal(frame.data, "a", 1);
    testbed_end(block);
    hub_close();
}

/* A 0 of `enable` counts where it is a command: not where it is old, and with a wire at `flag` not where that is 0. */
static void a_drive_waits_for_an_enable_of_0(void **state)
{
    (void)state;
    hub_open();
    static const struct {
        bool wired, flag, enable;
        double age;
        int waits;
    } cases[] = {{0, 0, 1, 0, FL_WAITS}, {0, 0, 0, 0, FL_WAIT_NOT}, {0, 0, 0, 1, FL_WAITS},
                 {1, 0, 0, 0, FL_WAITS}, {1, 1, 1, 0, FL_WAITS},    {1, 1, 0, 0, FL_WAIT_NOT}};
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        struct fl_block *block = testbed_block("epos2", "node", "5", "mode", "velocity", "timeout", "0.1", NULL);
        if (cases[i].wired)
            testbed_wire(block, "flag");
        block->service->wait = FL_WAIT_BEGUN;
        testbed_begin(block);
        SET(block, "flag", bool, cases[i].flag);
        SET(block, "enable", bool, cases[i].enable);
        SET(block, "age", double, cases[i].age);
        assert_int_equal(testbed_step(block), FL_OK);
        assert_int_equal(block->service->wait, cases[i].waits);
        testbed_end(block);
    }
    hub_close();
}

/* Neither reset frame nor drive can be reached while the interface is down, and a send without a reset has none. */
static void says_what_could_not_be_reset(void **state)
{
    (void)state;
    hub_open();
    struct fl_block *blocks[] = {testbed_block("can-send", "id", "5", "length", "1", NULL),
                                 testbed_block("can-send", "id", "5", "length", "1", "reset", "00", NULL),
                                 testbed_block("epos2", "node", "5", "mode", "velocity", NULL)};
    for (size_t i = 0; i < 3; i++) {
        testbed_begin(blocks[i]);
        hub_link("7 up");
        blocks[i]->type->safe(blocks[i]);
        assert_null(blocks[i]->service->not_safe);
        hub_link("7 down");
        blocks[i]->type->safe(blocks[i]);
        assert_int_equal(!blocks[i]->service->not_safe, i == 0);
        testbed_end(blocks[i]);
    }
    hub_close();
}

/* The words that the drive is commanded, by each of three ways, from the hub's next frame on; the word of the last. */
static uint16_t commanded(struct can_frame *last)
{
    static const canid_t ways[] = {0x505, 0x205, 0x605};
    uint16_t words[] = {0, 0, 0};
    for (size_t i = 0; i < 3; i++) {
        assert_int_equal(last->can_id, ways[i]);
        memcpy(&words[i], last->data + (i == 2 ? 4 : 0), 2);
        assert_true(hub_take(last) || i == 2);
    }
    assert_int_equal(words[0], words[1]);
    assert_int_equal(words[0], words[2]);
    return words[0];
}

/* Nobody answers: the quick stop is sent again for a while, and then the power is taken off all the same. */
static void a_drive_is_stopped_by_safe_and_disabled_at_the_end(void **state)
{
    (void)state;
    struct can_frame frame;
    uint16_t word;
    unsigned stops;
    hub_open();
    struct fl_block *block = testbed_block("epos2", "node", "5", "mode", "velocity", NULL);
    testbed_begin(block);
    assert_int_equal(testbed_step(block), FL_OK);
    while (hub_take(&frame))
        ;
    block->type->safe(block);
    testbed_end(block);
    assert_true(hub_take(&frame));
    for (stops = 0; (word = commanded(&frame)) == 0x0002; stops++)
        ;
    assert_in_range(stops, 2, 9);
    assert_int_equal(word, 0);
    assert_int_equal(frame.can_id, 0);
    assert_memory_equal(frame.data, "\x82\x05", 2);
    hub_close();
}

static unsigned syncs(void)
{
    struct can_frame frame;
    unsigned count = 0;
    while (hub_take(&frame))
        count += frame.can_id == 0x080;
    return count;
}

/* On one bus, here in one process as well as elsewhere: only the kernel knows of the claim. */
static void one_block_sends_sync(void **state)
{
    (void)state;
    enum { DRIVES = 4, STEPS = 10 };
    struct fl_block *drives[DRIVES];
    char node[4], master[4];
    hub_open();
    for (int i = 0; i < DRIVES; i++) {
        snprintf(node, sizeof node, "%d", i + 1);
        snprintf(master, sizeof master, "%d", 120 + i);
        drives[i] = testbed_block("epos2", "node", node, "master", master, "mode", "velocity", NULL);
        testbed_begin(drives[i]);
    }
    syncs();
    for (int step = 0; step < STEPS; step++) {
        for (int i = 0; i < DRIVES; i++) {
            assert_int_equal(testbed_step(drives[i]), FL_OK);
            assert_int_equal(syncs(), i == 0); /* the first that started */
        }
    }
    testbed_end(drives[0]);
    unsigned sent = 0;
    for (int64_t from_ns = fl_now_ns(); !sent; sent = syncs()) { /* then one of the others takes over */
        assert_true(fl_now_ns() - from_ns < INT64_C(30000000000));
        for (int i = 1; i < DRIVES; i++)
            assert_int_equal(testbed_step(drives[i]), FL_OK);
    }
    for (int step = 0; step < STEPS; step++) {
        for (int i = 1; i < DRIVES; i++)
            assert_int_equal(testbed_step(drives[i]), FL_OK);
        assert_int_equal(syncs(), 1);
    }
    struct fl_block *silent = testbed_block("epos2", "node", "9", "mode", "velocity", "sync", "none", NULL);
    for (int i = 1; i < DRIVES; i++)
        testbed_end(drives[i]);
    testbed_begin(silent);
    for (int step = 0; step < STEPS; step++)
        assert_int_equal(testbed_step(silent), FL_OK);
    assert_int_equal(syncs(), 0);
    testbed_end(silent);
    hub_close();
}

static void steps_never_block(void **state)
{
    (void)state;
    hub_open();
    struct fl_block *blocks[] = {
        testbed_block("epos2", "node", "5", "mode", "velocity", NULL),
        testbed_block("can-receive", "id", "5", NULL),
        testbed_block("can-send", "id", "5", NULL),
    };
    for (size_t i = 0; i < 3; i++) {
        testbed_begin(blocks[i]);
        steps_under_seccomp(blocks[i], 10);
        testbed_end(blocks[i]);
    }
    hub_close();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(receives_the_newest),
        cmocka_unit_test(gives_the_newest_of_many),
        cmocka_unit_test(gives_the_newest_of_a_drive),
        cmocka_unit_test(ages_from_the_kernels_stamp),
        cmocka_unit_test(goes_bad_with_age),
        cmocka_unit_test(filters),
        cmocka_unit_test(bus_off_is_no_good),
        cmocka_unit_test(sends),
        cmocka_unit_test(resets_what_is_old),
        cmocka_unit_test(refuses),
        cmocka_unit_test(sends_when_the_interface_comes),
        cmocka_unit_test(receives_again_after_unplugging),
        cmocka_unit_test(bus_off_ends_with_the_interface),
        cmocka_unit_test(a_drive_is_begun_anew_with_its_interface),
        cmocka_unit_test(says_what_could_not_be_reset),
        cmocka_unit_test(waits_for_a_command_that_is_off),
        cmocka_unit_test(a_drive_waits_for_an_enable_of_0),
        cmocka_unit_test(a_drive_is_stopped_by_safe_and_disabled_at_the_end),
        cmocka_unit_test(one_block_sends_sync),
        cmocka_unit_test(steps_never_block),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
