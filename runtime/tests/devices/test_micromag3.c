#define _GNU_SOURCE
#include "blocks/devices/micromag3_frame.h"
#include "line.h"
#include "said.h"
#include "seccomp.h"

static const double DEGREE = 3.14159265358979323846 / 180;

/* The CommBoard manual's own example of the standard output; its checksum is none that the manual describes. */
#define PUBLISHED "$C194.74X-106.00Y-403.00Z98.00:E200*1E\r\n"
/* The same with the exclusive or. */
#define SOUND "$C194.74X-106.00Y-403.00Z98.00:E200*6B\r\n"

static unsigned samples(const char *bytes, bool any_checksum, struct micromag3_sample *sample)
{
    struct micromag3_parser parser = {.any_checksum = any_checksum};
    unsigned count = 0;
    for (; *bytes; bytes++)
        count += micromag3_feed(&parser, (uint8_t)*bytes, sample);
    return count;
}

static void reads_the_published_record(void **state)
{
    (void)state;
    struct micromag3_sample sample;
    assert_int_equal(samples(PUBLISHED, false, &sample), 0);
    for (int i = 0; i < 2; i++) {
        assert_int_equal(i ? samples(SOUND, false, &sample) : samples(PUBLISHED, true, &sample), 1);
        assert_near(sample.heading, 194.74, 1e-12);
        assert_near(sample.field[0], -106, 0);
        assert_near(sample.field[1], -403, 0);
        assert_near(sample.field[2], 98, 0);
        assert_int_equal(sample.error, 0x200);
        assert_int_equal(sample.contains, MICROMAG3_HEADING | MICROMAG3_FIELD);
    }
}

static const char *record_of(const char *text)
{
    return line_record(text, '*');
}

static void reads_what_the_board_is_configured_to_send(void **state)
{
    (void)state;
    struct micromag3_sample sample;
    assert_int_equal(samples(record_of("C0.00"), false, &sample), 1);
    assert_int_equal(sample.contains, MICROMAG3_HEADING);
    assert_int_equal(samples(record_of("X1.5Y-2Z3"), false, &sample), 1);
    assert_int_equal(sample.contains, MICROMAG3_FIELD);
    assert_near(sample.field[1], -2, 0);
    assert_int_equal(samples(record_of("raw,X53Y-420Z0"), false, &sample), 1); /* the manual's, checksum amended */
    assert_near(sample.field[1], -420, 0);
    assert_int_equal(sample.error, 0);
    /* As it is shipped, without z. */
    assert_int_equal(samples(record_of("raw,X53Y-420"), false, &sample), 1);
    assert_int_equal(sample.contains, MICROMAG3_FIELD);
    assert_near(sample.field[1], -420, 0);
    assert_near(sample.field[2], 0, 0);
}

static void refuses_other_records(void **state)
{
    (void)state;
    static const char *const wrong[] = {
        "",        "C",      "C1.0C2.0", "X1Z2",         "C1.0:", "C1.0:E",      "C1.0:EG", "C1.0:E20*", "C1.0:E12345",
        "C360.00", "C-0.01", "C1.0 ",    "C1.0:F1",      "h",     "pollfreq=08", "go",      "C1.2.3",    "C1e3",
        "raw,",    "C.",     "C194",     "C194X1.0Y2.0", /* mils: page 15 */
    };
    struct micromag3_sample sample;
    for (size_t i = 0; i < sizeof wrong / sizeof wrong[0]; i++)
        if (samples(record_of(wrong[i]), false, &sample))
            fail_msg("accepted: %s", wrong[i]);
}

static void refuses_each_flipped_bit(void **state)
{
    (void)state;
    struct micromag3_sample sample;
    for (size_t at = 0; at < strlen(SOUND) - 1; at++) { /* the LF is not needed */
        for (unsigned bit = 0; bit < 8; bit++) {
            char flipped[] = SOUND;
            flipped[at] = (char)(flipped[at] ^ 1 << bit);
            /* A flipped CR may become the other end of a line. */
            if (samples(flipped, false, &sample))
                fail_msg("accepted with bit %u of byte %zu flipped", bit, at);
        }
    }
}

static void comes_back_after_garbage(void **state)
{
    (void)state;
    struct micromag3_sample sample;
    assert_int_equal(samples("*6B\r\n\x01\xff" SOUND, false, &sample), 1);
    assert_int_equal(samples("$C194.74X-10" SOUND, false, &sample), 1);
    assert_int_equal(samples("$C194.74*" SOUND "$" SOUND, false, &sample), 2);
    char endless[1000] = "$";
    memset(endless + 1, 'X', sizeof endless - 2);
    endless[sizeof endless - 1] = '\0';
    assert_int_equal(samples(endless, false, &sample), 0);
}

/* --- the block --- */

static void starts_the_stream(void **state)
{
    (void)state;
    struct line line = line_create();
    struct fl_block *compass = testbed_block("micromag3", "device", line.path, "pollfreq", "16", "timeout", "60", NULL);
    testbed_begin(compass);
    assert_true(line_receives(&line, "h\r"));
    line_say(&line, record_of("h"));
    /* All that a measurement's meaning depends on, each confirmed before the next. */
    static const char *const settings[] = {"uc=d", "sn=m", "sdo=t", "ec=e", "ex=e", "ey=e", "ez=e"};
    for (size_t i = 0; i < sizeof settings / sizeof settings[0]; i++) {
        assert_true(line_receives(&line, settings[i]));
        line_say(&line, record_of(settings[i]));
    }
    assert_true(line_receives(&line, "pollfreq=16\r")); /* whatever it answers */
    assert_true(line_receives(&line, "go\r"));
    assert_int_equal(line_step(compass), FL_OK);
    assert_false(GET(compass, "flag", bool));
    line_say(&line, record_of("C90.00X1.0Y2.0Z3.0"));
    steps_under_seccomp(compass, 3);
    STEP_UNTIL(compass, GET(compass, "flag", bool));
    assert_near(GET(compass, "heading", double), 90 * DEGREE, 1e-12);
    assert_near(((const double *)testbed_output(compass, "field"))[2], 3, 0);
    assert_int_equal(GET(compass, "sequence", uint32_t), 1);
    /* An error is no measurement, but it is reported. */
    line_say(&line, SOUND);
    STEP_UNTIL(compass, GET(compass, "error", uint16_t) == 0x200);
    assert_false(GET(compass, "flag", bool));
    assert_near(GET(compass, "heading", double), 90 * DEGREE, 1e-12);
    compass->type->terminate(compass);
    assert_true(line_receives(&line, "h\r"));
    testbed_end(compass);
    line_unplug(&line);
}

static void asks_for_samples(void **state)
{
    (void)state;
    static const struct {
        const char *mode, *question, *answer;
    } cases[] = {{"poll", "\rs?\r", "C10.00"}, {"raw", "\rsr?\r", "raw,X1Y2Z3"}, {"raw", "\rsr?\r", "raw,X1Y2"}};
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        struct line line = line_create();
        struct fl_block *compass =
            testbed_block("micromag3", "device", line.path, "mode", cases[i].mode, "timeout", "60", NULL);
        testbed_begin(compass);
        assert_true(line_receives(&line, cases[i].question));
        for (uint32_t sample = 1; sample < 4; sample++) {
            line_say(&line, record_of(cases[i].answer));
            assert_true(line_receives(&line, cases[i].question + 1));
            STEP_UNTIL(compass, GET(compass, "sequence", uint32_t) == sample);
        }
        assert_true(GET(compass, "flag", bool));
        testbed_end(compass);
        line_unplug(&line);
    }
}

/* A board that streams on and hears nothing, in mils: 194 of 6400 was taken for 194 degrees. */
static void does_not_take_mils_for_degrees(void **state)
{
    (void)state;
    struct line line = line_create();
    struct said said = said_begin();
    struct fl_block *compass = testbed_block("micromag3", "device", line.path, "timeout", "60", NULL);
    testbed_begin(compass);
    STEP_UNTIL(compass, (line_say(&line, record_of("C194X-106.00Y-403.00")), assert_false(GET(compass, "flag", bool)),
                         said_times(&said, "the heading is in mils")));
    testbed_end(compass);
    line_unplug(&line);
    said_end(&said);
}

/* What it measures before all is set may be of another's settings, and a lost command is said again. */
static void sets_a_board_that_streams_on(void **state)
{
    (void)state;
    struct line line = line_create();
    struct said said = said_begin();
    struct fl_block *compass = testbed_block("micromag3", "device", line.path, "timeout", "60", NULL);
    testbed_begin(compass);
    const int64_t from_ns = fl_now_ns();
    char received[4096] = "";
    size_t count = 0;
    fcntl(line.master, F_SETFL, O_NONBLOCK);
    while (!strstr(received, "go\r")) {
        line_say(&line, record_of("C194.00X-106.00Y-403.00"));
        ssize_t more = read(line.master, received + count, sizeof received - 1 - count);
        count += more > 0 ? (size_t)more : 0;
        assert_int_equal(line_step(compass), FL_OK);
        assert_true(strstr(received, "go\r") || !GET(compass, "flag", bool));
        assert_true(line_tick(from_ns));
    }
    assert_non_null(strstr(received, "uc=d\ruc=d\ruc=d\rsn=m\r"));
    STEP_UNTIL(compass, (line_say(&line, record_of("C194.00X-106.00Y-403.00")), GET(compass, "flag", bool)));
    AWAIT(said_times(&said, "the board does not confirm settings, uc=d first") == 1);
    testbed_end(compass);
    line_unplug(&line);
    said_end(&said);
}

static void says_what_is_wrong(void **state)
{
    (void)state;
    struct line line = line_create();
    struct said said = said_begin();
    struct fl_block *compass = testbed_block("micromag3", "device", line.path, NULL);
    testbed_begin(compass);
    assert_true(line_receives(&line, "go\r"));
    line_say(&line, PUBLISHED);
    AWAIT(said_times(&said, "a record's checksum is wrong: check the cable, or set checksum: none") == 1);
    line_say(&line, SOUND);
    AWAIT(said_times(&said, "the board reports error 200: manual, page 11") == 1);
    testbed_end(compass);
    line_unplug(&line);
    said_end(&said);
}

static void grows_stale_and_notices_unplugging(void **state)
{
    (void)state;
    struct line line = line_create();
    struct fl_block *compass =
        testbed_block("micromag3", "device", line.path, "checksum", "none", "timeout", "30", NULL);
    testbed_begin(compass);
    assert_true(line_receives(&line, "go\r"));
    line_say(&line, "$C194.74X-106.00Y-403.00Z98.00*1E\r\n");
    STEP_UNTIL(compass, GET(compass, "flag", bool));
    compass->release_ns = fl_now_ns() + 31 * INT64_C(1000000000);
    assert_int_equal(testbed_step(compass), FL_OK);
    assert_false(GET(compass, "flag", bool));
    assert_int_equal(line_step(compass), FL_OK);
    assert_true(GET(compass, "flag", bool));
    line_unplug(&line);
    STEP_UNTIL(compass, !GET(compass, "flag", bool));
    line_plug(&line);
    assert_true(line_receives(&line, "go\r"));
    assert_int_equal(line_step(compass), FL_OK);
    assert_false(GET(compass, "flag", bool)); /* the value is as good as before, but of before */
    line_say(&line, "$C1.00X-106.00Y-403.00Z98.00*1E\r\n");
    STEP_UNTIL(compass, GET(compass, "sequence", uint32_t) == 2);
    assert_true(GET(compass, "flag", bool));
    testbed_end(compass);
    line_unplug(&line);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(reads_the_published_record),
        cmocka_unit_test(reads_what_the_board_is_configured_to_send),
        cmocka_unit_test(refuses_other_records),
        cmocka_unit_test(refuses_each_flipped_bit),
        cmocka_unit_test(comes_back_after_garbage),
        cmocka_unit_test(starts_the_stream),
        cmocka_unit_test(asks_for_samples),
        cmocka_unit_test(grows_stale_and_notices_unplugging),
        cmocka_unit_test(does_not_take_mils_for_degrees),
        cmocka_unit_test(sets_a_board_that_streams_on),
        cmocka_unit_test(says_what_is_wrong),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
