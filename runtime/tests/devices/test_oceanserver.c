#define _GNU_SOURCE
#include "blocks/devices/oceanserver_frame.h"
#include "line.h"
#include "said.h"
#include "seccomp.h"

#include <sched.h>
#include <sys/ioctl.h>

static const char *const vectors[] = {
    "$S,01,270F,02,00,04,60%21\r\n",
    "$C1,01,FF,02,00,03,FF,04,00,05,00,06,00,07,00%72\r\n",
    "$B11,02,000A,01,0294,03,0080,08,0B94,09,4115,0A,FFEC,0B,FEC3%3D\r\n",
};

static unsigned samples(const char *bytes, struct oceanserver_sample *sample)
{
    struct record record = {0};
    unsigned count = 0;
    for (; *bytes; bytes++)
        count += oceanserver_feed(&record, (uint8_t)*bytes, sample);
    return count;
}

static uint16_t value_of(const struct oceanserver_sample *sample, uint8_t number)
{
    uint16_t value;
    assert_true(oceanserver_value(sample, number, &value));
    return value;
}

static void reads_the_vectors(void **state)
{
    (void)state;
    struct oceanserver_sample sample;
    uint16_t value;
    assert_int_equal(samples(vectors[0], &sample), 1);
    assert_int_equal(sample.kind, OCEANSERVER_SYSTEM);
    assert_int_equal(value_of(&sample, OCEANSERVER_S_MINUTES), 9999);
    assert_int_equal(value_of(&sample, OCEANSERVER_S_CHARGE), 96);
    assert_int_equal(samples(vectors[1], &sample), 1);
    assert_int_equal(sample.kind, OCEANSERVER_CONTROLLER);
    assert_int_equal(sample.controller, 1);
    assert_int_equal(value_of(&sample, OCEANSERVER_C_PRESENT), 0xFF);
    assert_int_equal(value_of(&sample, OCEANSERVER_C_INHIBITED), 0);
    assert_int_equal(sample.count, 7);
    assert_int_equal(samples(vectors[2], &sample), 1);
    assert_int_equal(sample.kind, OCEANSERVER_BATTERY);
    assert_int_equal(sample.controller, 1);
    assert_int_equal(sample.battery, 1);
    assert_int_equal(value_of(&sample, OCEANSERVER_B_TEMPERATURE), 2964); /* 296.4 K */
    assert_int_equal(value_of(&sample, OCEANSERVER_B_VOLTAGE), 16661);
    assert_int_equal((int16_t)value_of(&sample, OCEANSERVER_B_CURRENT), -20);
    assert_false(oceanserver_value(&sample, OCEANSERVER_B_CHARGE, &value));
}

/* A burst that a PR2's controller sent: ocean_battery_driver, src/ocean_battery_driver/testfile.txt, lines 18 to 23. */
static const char *const recorded[] = {
    "$S,01,270F,02,00,04,1D%52\n",
    "$C1,01,0F,02,0F,03,00,04,00,05,0F,06,00,07,00%04\n",
    "$B11,08,0BF6,0F,078C,0A,0814,09,3CE9,0D,001D,16,0080%35\n",
    "$B12,08,0BE3,0F,0728,0A,07E8,09,3CE6,0D,001C,16,0080%3E\n",
    "$B13,08,0BD1,0F,079C,0A,07D1,09,3D31,0D,001D,16,0080%35\n",
    "$B14,08,0BC6,0F,07BA,0A,07D2,09,3CBF,0D,001E,16,0080%48\n",
};

static void reads_what_a_pr2_recorded(void **state)
{
    (void)state;
    struct oceanserver_sample sample;
    for (size_t i = 0; i < sizeof recorded / sizeof recorded[0]; i++)
        assert_int_equal(samples(recorded[i], &sample), 1);
    assert_int_equal(sample.battery, 4);
    assert_int_equal(value_of(&sample, OCEANSERVER_B_TEMPERATURE), 3014);
    assert_int_equal(value_of(&sample, OCEANSERVER_B_VOLTAGE), 15551);
    assert_int_equal(value_of(&sample, OCEANSERVER_B_CURRENT), 2002);
    assert_int_equal(value_of(&sample, OCEANSERVER_B_CHARGE), 30);
}

static const char *record_of(const char *text)
{
    return line_record(text, '%');
}

/* gearbox, gbxsmartbatteryacfr/smartbatteryparsing.cpp: FFFF, or FF of two digits, "caused by a collision". */
static void a_collision_is_no_value(void **state)
{
    (void)state;
    struct oceanserver_sample sample;
    uint16_t value;
    assert_int_equal(samples(record_of("B11,08,FFFF,09,FFFF,0A,FFFF,0D,FFFF,16,0080"), &sample), 1);
    for (uint8_t number = OCEANSERVER_B_TEMPERATURE; number <= OCEANSERVER_B_CHARGE; number++)
        assert_false(oceanserver_value(&sample, number, &value));
    assert_int_equal(value_of(&sample, 0x16), 0x80);
    assert_int_equal(samples(record_of("B11,0A,FFFE,0D,0064"), &sample), 1);
    assert_int_equal((int16_t)value_of(&sample, OCEANSERVER_B_CURRENT), -2);
    assert_int_equal(value_of(&sample, OCEANSERVER_B_CHARGE), 100);
    assert_int_equal(samples(record_of("S,01,FFFF,02,00,04,FF"), &sample), 1);
    assert_false(oceanserver_value(&sample, OCEANSERVER_S_MINUTES, &value));
    assert_false(oceanserver_value(&sample, OCEANSERVER_S_CHARGE, &value));
    assert_int_equal(samples(record_of("C1,01,FF"), &sample), 1);
    assert_int_equal(value_of(&sample, OCEANSERVER_C_PRESENT), 0xFF); /* eight batteries */
}

/* PR2's and gearbox's drivers both know key 03 of $S as a message in ASCII. */
static void a_message_takes_nothing_with_it(void **state)
{
    (void)state;
    static const char *const messages[] = {"", "Low", "Charge now, or stop", "4E", ",", "shut down, 5 min,"};
    for (size_t i = 0; i < sizeof messages / sizeof messages[0]; i++) {
        struct oceanserver_sample sample;
        char text[100];
        snprintf(text, sizeof text, "S,01,0078,02,00,03,%s,04,0A", messages[i]);
        assert_int_equal(samples(record_of(text), &sample), 1);
        assert_int_equal(value_of(&sample, OCEANSERVER_S_MINUTES), 120);
        assert_int_equal(value_of(&sample, OCEANSERVER_S_CHARGE), 10);
        assert_int_equal(sample.count, 3);
    }
    struct oceanserver_sample sample;
    assert_int_equal(samples(record_of("S,01,0078,02,00,04,0A,03,Low"), &sample), 1);
    assert_int_equal(value_of(&sample, OCEANSERVER_S_CHARGE), 10);
}

static void refuses_each_flipped_bit(void **state)
{
    (void)state;
    struct oceanserver_sample sample;
    for (size_t i = 0; i < sizeof vectors / sizeof vectors[0]; i++) {
        for (size_t at = 0; at < strlen(vectors[i]) - 1; at++) {
            for (unsigned bit = 0; bit < 8; bit++) {
                char flipped[128];
                strcpy(flipped, vectors[i]);
                flipped[at] = (char)(flipped[at] ^ 1 << bit);
                if (samples(flipped, &sample))
                    fail_msg("accepted with bit %u of byte %zu flipped: %s", bit, at, flipped);
            }
        }
    }
}

static void refuses_other_records(void **state)
{
    (void)state;
    static const char *const wrong[] = {
        "",
        "X,01,00",
        "S01,00",
        "S,01",
        "S,01,",
        "S,,00",
        "S,01,00,",
        "S,01,12345",
        "S,001,00",
        "C,01,00",
        "C0,01,00",
        "B1,01,00",
        "B10,01,00",
        "S,0g,00",
        "S,01,0f",
        "S,01,-1",
        "S,01 ,00",
        "S,01,00,01,00,01,00,01,00,01,00,01,00,01,00,01,00,01,00,01,00,01,00,01,00,01,00,01,00,01,00,01,00,01,00",
    };
    struct oceanserver_sample sample;
    for (size_t i = 0; i < sizeof wrong / sizeof wrong[0]; i++)
        if (samples(record_of(wrong[i]), &sample))
            fail_msg("accepted: %s", wrong[i]);
}

static void comes_back_after_garbage(void **state)
{
    (void)state;
    struct oceanserver_sample sample;
    char text[256];
    snprintf(text, sizeof text, "Main menu %%\r\n\xff$B11,02,00%s%s", vectors[0], vectors[1]);
    assert_int_equal(samples(text, &sample), 2);
    assert_int_equal(sample.kind, OCEANSERVER_CONTROLLER);
}

/* --- the block --- */

static struct fl_block *streaming(struct line *line, const char *timeout)
{
    *line = line_create();
    struct fl_block *batteries = testbed_block("oceanserver", "device", line->path, "timeout", timeout, NULL);
    testbed_begin(batteries);
    assert_true(line_receives(line, " "));
    line_say(line, "OceanServer Battery Controller\r\n x - hex\r\n");
    assert_true(line_receives(line, "x"));
    return batteries;
}

static double element(const struct fl_block *block, const char *port, unsigned index)
{
    return ((const double *)testbed_output((struct fl_block *)(uintptr_t)block, port))[index];
}

static void is_good_when_all_parts_are_there(void **state)
{
    (void)state;
    struct line line;
    struct fl_block *batteries = streaming(&line, "60");
    line_say(&line, vectors[0]);
    line_say(&line, record_of("C1,01,03,02,01,03,02,05,01,06,02,07,04"));
    line_say(&line, vectors[2]);
    STEP_UNTIL(batteries, element(batteries, "voltage", 0) > 0);
    assert_false(GET(batteries, "flag", bool)); /* the second is said to be there, but is silent */
    line_say(&line, record_of("B21,09,1000"));  /* another controller's */
    line_say(&line, record_of("B12,08,0BB8,09,3A98,0A,01F4"));
    line_say(&line, record_of("B12,0D,0064"));
    steps_under_seccomp(batteries, 3);
    STEP_UNTIL(batteries, GET(batteries, "sequence", uint32_t) == 6);
    assert_true(GET(batteries, "flag", bool));
    assert_near(GET(batteries, "remaining", double), 9999 * 60, 0);
    assert_near(GET(batteries, "charge", double), 0.96, 1e-12);
    assert_int_equal(GET(batteries, "present", uint8_t), 3);
    assert_int_equal(GET(batteries, "charging", uint8_t), 1);
    assert_int_equal(GET(batteries, "discharging", uint8_t), 2);
    assert_int_equal(GET(batteries, "external_power", uint8_t), 1);
    assert_int_equal(GET(batteries, "power_not_good", uint8_t), 2);
    assert_int_equal(GET(batteries, "inhibited", uint8_t), 4);
    assert_near(element(batteries, "temperature", 0), 296.4, 1e-9);
    assert_near(element(batteries, "voltage", 0), 16.661, 1e-9);
    assert_near(element(batteries, "current", 0), -0.02, 1e-9);
    assert_near(element(batteries, "temperature", 1), 300, 1e-9);
    assert_near(element(batteries, "voltage", 1), 15, 1e-9);
    assert_near(element(batteries, "current", 1), 0.5, 1e-9);
    assert_near(element(batteries, "charges", 1), 1, 1e-9);
    testbed_end(batteries);
    line_unplug(&line);
}

/* Steps that are far apart: what arrived last counts. Seen to fail: the first 64 records were kept. */
static void gives_the_newest_after_many(void **state)
{
    (void)state;
    enum { MANY = 99 };
    struct line line;
    char record[16];
    struct fl_block *batteries = streaming(&line, "60");
    for (int percent = 1; percent <= MANY; percent++) {
        snprintf(record, sizeof record, "S,01,0001,04,%02X", (unsigned)percent);
        line_say(&line, record_of(record));
    }
    int port = open(line.path, O_RDONLY | O_NOCTTY | O_CLOEXEC), waiting = 1;
    while (waiting) { /* for the block's thread */
        assert_int_equal(ioctl(port, FIONREAD, &waiting), 0);
        sched_yield();
    }
    close(port);
    STEP_UNTIL(batteries, GET(batteries, "charge", double) > (MANY - 0.5) / 100);
    testbed_end(batteries);
    line_unplug(&line);
}

/* The controller goes on talking, but one battery's values are old. */
static void one_silent_part_is_enough_to_be_stale(void **state)
{
    (void)state;
    struct line line;
    struct fl_block *batteries = streaming(&line, "1");
    int64_t from_ns = fl_now_ns();
    STEP_UNTIL(batteries, (line_say(&line, vectors[0]), line_say(&line, record_of("C1,01,01")),
                           line_say(&line, vectors[2]), GET(batteries, "flag", bool)));
    STEP_UNTIL(batteries,
               (line_say(&line, vectors[0]), line_say(&line, record_of("C1,01,01")), !GET(batteries, "flag", bool)));
    assert_true(fl_now_ns() - from_ns > 1000 * 1000 * 1000);
    assert_true(GET(batteries, "age", double) > 1);
    STEP_UNTIL(batteries, (line_say(&line, vectors[2]), GET(batteries, "flag", bool)));
    testbed_end(batteries);
    line_unplug(&line);
}

static void notices_unplugging_and_comes_back(void **state)
{
    (void)state;
    struct line line;
    struct fl_block *batteries = streaming(&line, "60");
    STEP_UNTIL(batteries, (line_say(&line, vectors[0]), line_say(&line, record_of("C1,01,01")),
                           line_say(&line, vectors[2]), GET(batteries, "flag", bool)));
    line_unplug(&line);
    STEP_UNTIL(batteries, !GET(batteries, "flag", bool));
    line_plug(&line);
    assert_true(line_receives(&line, " "));
    assert_true(line_receives(&line, "x"));
    line_say(&line, vectors[0]);
    STEP_UNTIL(batteries, GET(batteries, "flag", bool));
    testbed_end(batteries);
    line_unplug(&line);
}

/* 65.5 V with a flag of 1, at one time. */
static void a_collision_leaves_the_value_and_its_age(void **state)
{
    (void)state;
    struct line line;
    struct said said = said_begin();
    struct fl_block *batteries = streaming(&line, "1");
    STEP_UNTIL(batteries, (line_say(&line, vectors[0]), line_say(&line, record_of("C1,01,01")),
                           line_say(&line, vectors[2]), GET(batteries, "flag", bool)));
    static const struct {
        const char *output, *record;
    } collisions[] = {
        {"voltage", "B11,08,0B94,09,FFFF,0A,FFEC"},
        {"temperature", "B11,08,FFFF,09,4115,0A,FFEC"},
        {"current", "B11,08,0B94,09,4115,0A,FFFF"},
    };
    for (size_t i = 0; i < sizeof collisions / sizeof collisions[0]; i++) {
        double before = element(batteries, collisions[i].output, 0);
        STEP_UNTIL(batteries, (line_say(&line, vectors[0]), line_say(&line, record_of("C1,01,01")),
                               line_say(&line, record_of(collisions[i].record)), !GET(batteries, "flag", bool)));
        assert_near(element(batteries, collisions[i].output, 0), before, 0);
        STEP_UNTIL(batteries, (line_say(&line, vectors[2]), GET(batteries, "flag", bool)));
    }
    assert_int_equal(said_times(&said, "FFFF, a collision"), 1);
    testbed_end(batteries);
    line_unplug(&line);
    said_end(&said);
}

/* A controller that streams finishes its record before it shows the menu. */
static void a_record_on_the_wire_does_not_stand_for_the_stream(void **state)
{
    (void)state;
    char received;
    struct line line = line_create();
    struct fl_block *batteries = testbed_block("oceanserver", "device", line.path, "timeout", "60", NULL);
    testbed_begin(batteries);
    assert_true(line_receives(&line, " "));
    line_say(&line, vectors[2]);
    line_say(&line, "OceanServer Battery Controller\r\n x - hex\r\n");
    struct pollfd waiting = {.fd = line.master, .events = POLLIN};
    assert_int_equal(poll(&waiting, 1, AWAIT_MS), 1);
    assert_int_equal(read(line.master, &received, 1), 1);
    assert_int_equal(received, 'x');
    testbed_end(batteries);
    line_unplug(&line);
}

static void says_what_is_wrong(void **state)
{
    (void)state;
    struct line line;
    struct said said = said_begin();
    struct fl_block *batteries = streaming(&line, "60");
    line_say(&line, "$S,01,270F,02,00,04,61%21\r\n");
    AWAIT(said_times(&said, "a record's checksum is wrong: check the cable"));
    line_say(&line, record_of("C360.00"));
    AWAIT(said_times(&said, "a record that no battery controller sends: check what is connected"));
    assert_int_equal(said_times(&said, line.path), 2);
    testbed_end(batteries);
    line_unplug(&line);
    said_end(&said);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(reads_the_vectors),
        cmocka_unit_test(reads_what_a_pr2_recorded),
        cmocka_unit_test(a_collision_is_no_value),
        cmocka_unit_test(a_message_takes_nothing_with_it),
        cmocka_unit_test(refuses_each_flipped_bit),
        cmocka_unit_test(refuses_other_records),
        cmocka_unit_test(comes_back_after_garbage),
        cmocka_unit_test(is_good_when_all_parts_are_there),
        cmocka_unit_test(gives_the_newest_after_many),
        cmocka_unit_test(one_silent_part_is_enough_to_be_stale),
        cmocka_unit_test(notices_unplugging_and_comes_back),
        cmocka_unit_test(a_collision_leaves_the_value_and_its_age),
        cmocka_unit_test(a_record_on_the_wire_does_not_stand_for_the_stream),
        cmocka_unit_test(says_what_is_wrong),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
