#define _GNU_SOURCE
#include "blocks/serial/oceanserver_frame.h"
#include "line.h"
#include "seccomp.h"

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

static const char *record_of(const char *text)
{
    return line_record(text, '%');
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
    assert_true(line_hears(line, " "));
    line_say(line, "OceanServer Battery Controller\r\n x - hex\r\n");
    assert_true(line_hears(line, "x"));
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
    assert_true(line_hears(&line, " "));
    assert_true(line_hears(&line, "x"));
    line_say(&line, vectors[0]);
    STEP_UNTIL(batteries, GET(batteries, "flag", bool));
    testbed_end(batteries);
    line_unplug(&line);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(reads_the_vectors),
        cmocka_unit_test(refuses_each_flipped_bit),
        cmocka_unit_test(refuses_other_records),
        cmocka_unit_test(comes_back_after_garbage),
        cmocka_unit_test(is_good_when_all_parts_are_there),
        cmocka_unit_test(one_silent_part_is_enough_to_be_stale),
        cmocka_unit_test(notices_unplugging_and_comes_back),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
