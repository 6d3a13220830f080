#define _GNU_SOURCE
#include "blocks/serial/urg_frame.h"
#include "line.h"
#include "seccomp.h"

#include <math.h>

static void sums_as_published(void **state)
{
    (void)state;
    /* Lines of the specification: the statuses, and the answer to PP without its semicolons. */
    static const char *const lines[] = {"00P",      "99b",       "DMIN:204",  "DMAX:5600_",
                                        "AMIN:447", "AMAX:725o", "AFRT:3846", "SCAN:600e"};
    for (size_t i = 0; i < sizeof lines / sizeof lines[0]; i++)
        assert_int_equal(urg_checksum(lines[i], strlen(lines[i]) - 1), lines[i][strlen(lines[i]) - 1]);
}

static void asks_as_specified(void **state)
{
    (void)state;
    char command[URG_COMMAND + 1];
    urg_command(&(struct urg_request){44, 725, 0, 1, 3, true}, command);
    assert_string_equal(command, "MD0044072501000");
    urg_command(&(struct urg_request){0, 768, 3, 10, 2, true}, command);
    assert_string_equal(command, "MS0000076810300");
    urg_command(&(struct urg_request){44, 725, 0, 1, 3, false}, command);
    assert_string_equal(command, "GD0044072501");
}

static struct urg_scan scan;

static unsigned scans(struct urg_parser *parser, const char *bytes, size_t count)
{
    unsigned complete = 0;
    for (size_t i = 0; i < count; i++)
        complete += urg_feed(parser, (uint8_t)bytes[i], &scan);
    return complete;
}

static unsigned scans_of(const struct urg_request *request, const char *bytes, size_t count)
{
    static struct urg_parser parser;
    urg_expect(&parser, request);
    return scans(&parser, bytes, count);
}

/* A line with its checksum. */
static void append_line(char *text, const char *line, size_t count)
{
    size_t end = strlen(text);
    memcpy(text + end, line, count);
    text[end + count] = urg_checksum(line, count);
    text[end + count + 1] = '\n';
    text[end + count + 2] = '\0';
}

static void append_number(char *text, uint32_t number, int characters)
{
    size_t end = strlen(text);
    for (int i = 0; i < characters; i++)
        text[end + (size_t)i] = (char)((number >> (6 * (characters - 1 - i)) & 0x3F) + 0x30);
    text[end + (size_t)characters] = '\0';
}

/* A reply as the scanner gives it. */
static const char *reply_of(const struct urg_request *request, uint32_t timestamp, const uint32_t *points,
                            unsigned count)
{
    static char reply[8192], data[8192];
    char time[5] = "";
    urg_command(request, reply);
    strcat(reply, "\n");
    append_line(reply, request->stream ? "99" : "00", 2);
    append_number(time, timestamp, 4);
    append_line(reply, time, 4);
    *data = '\0';
    for (unsigned i = 0; i < count; i++)
        append_number(data, points[i], request->characters);
    size_t length = strlen(data);
    for (size_t at = 0; at < length; at += URG_BLOCK)
        append_line(reply, data + at, length - at < URG_BLOCK ? length - at : URG_BLOCK);
    return strcat(reply, "\n");
}

static void decodes_as_published(void **state)
{
    (void)state;
    /* 1Dh is 5432, CB is 1234, m2@0 is 16000000: the specification's examples. */
    static const char three[] = "MD0044004401000\n99b\nm2@0?\n1DhM\n\n", two[] = "GS0044004401\n00P\nm2@0?\nCB5\n\n";
    assert_int_equal(urg_checksum("m2@0", 4), '?');
    assert_int_equal(urg_checksum("1Dh", 3), 'M');
    assert_int_equal(urg_checksum("CB", 2), '5');
    assert_int_equal(scans_of(&(struct urg_request){44, 44, 0, 1, 3, true}, three, sizeof three - 1), 1);
    assert_int_equal(scan.timestamp, 16000000);
    assert_int_equal(scan.count, 1);
    assert_int_equal(scan.millimetres[0], 5432);
    assert_int_equal(scans_of(&(struct urg_request){44, 44, 0, 1, 2, false}, two, sizeof two - 1), 1);
    assert_int_equal(scan.millimetres[0], 1234);
}

static void reads_whole_scans(void **state)
{
    (void)state;
    static uint32_t points[URG_POINTS];
    static const struct urg_request requests[] = {
        {44, 725, 0, 1, 3, true},
        {44, 725, 0, 1, 2, false},
        {0, 768, 0, 7, 3, true},
        {0, URG_POINTS - 1, 0, 1, 3, true},
    };
    for (size_t r = 0; r < sizeof requests / sizeof requests[0]; r++) {
        unsigned count = urg_points(&requests[r]);
        for (unsigned i = 0; i < count; i++)
            points[i] = (i * 37 + 11) % 4096;
        const char *reply = reply_of(&requests[r], 0xFFFFFF, points, count);
        assert_int_equal(scans_of(&requests[r], reply, strlen(reply)), 1);
        assert_int_equal(scan.timestamp, 0xFFFFFF);
        assert_int_equal(scan.count, count);
        assert_memory_equal(scan.millimetres, points, count * sizeof points[0]);
    }
    assert_int_equal(urg_points(&requests[2]), 110);
}

static void refuses_each_flipped_bit(void **state)
{
    (void)state;
    static const struct urg_request request = {100, 149, 0, 1, 3, true};
    uint32_t points[50];
    for (uint32_t i = 0; i < 50; i++)
        points[i] = i * 4001 % 5600;
    const char *reply = reply_of(&request, 123456, points, 50);
    size_t length = strlen(reply);
    char flipped[512];
    for (size_t at = 0; at < length; at++) {
        for (unsigned bit = 0; bit < 8; bit++) {
            memcpy(flipped, reply, length);
            flipped[at] = (char)(flipped[at] ^ 1 << bit);
            if (scans_of(&request, flipped, length))
                fail_msg("accepted with bit %u of byte %zu flipped", bit, at);
        }
    }
}

static void refuses_other_replies(void **state)
{
    (void)state;
    static const struct urg_request request = {44, 45, 0, 1, 3, true};
    static const char *const wrong[] = {
        "MD0044004501000\n00P\n\n",                    /* only says that it will */
        "MD0044004501000\n10A\n\n",                    /* refused */
        "MD0044004601000\n99b\nm2@0?\n1Dh1Dhj\n\n",    /* another's */
        "MD0044004501000\n99b\nm2@0?\n1DhM\n\n",       /* too few points */
        "MD0044004501000\n99b\nm2@0?\n1Dh1Dh1DhG\n\n", /* too many */
        "MD0044004501000\n99b\n1Dh1Dhj\n\n",           /* no time */
        "MD0044004501000\n99b\nm2@0?\n\n",             /* no data */
        "MD0044004501000\n99b\nm2@0?\n1DhM\n",         /* not yet complete */
    };
    for (size_t i = 0; i < sizeof wrong / sizeof wrong[0]; i++)
        if (scans_of(&request, wrong[i], strlen(wrong[i])))
            fail_msg("accepted: %s", wrong[i]);
    /* A scan that does not end. */
    static struct urg_parser parser;
    static const char head[] = "MD0044004501000\n99b\nm2@0?\n", block[] = "1Dh1Dhj\n";
    urg_expect(&parser, &request);
    assert_int_equal(scans(&parser, head, sizeof head - 1), 0);
    for (int i = 0; i < URG_POINTS; i++)
        assert_int_equal(scans(&parser, block, sizeof block - 1), 0);
    assert_int_equal(scans(&parser, "\n", 1), 0);
    struct urg_parser idle = {0};
    static const char unasked[] = "\n00P\nm2@0?\n1DhM\n\n";
    assert_int_equal(scans(&idle, unasked, sizeof unasked - 1), 0);
}

static void comes_back_after_garbage(void **state)
{
    (void)state;
    static const struct urg_request request = {44, 143, 0, 1, 3, true};
    static struct urg_parser parser;
    uint32_t points[100] = {0};
    const char *reply = reply_of(&request, 1, points, 100);
    size_t length = strlen(reply);
    for (size_t cut = 1; cut < length; cut += 7) {
        urg_expect(&parser, &request);
        assert_true(scans(&parser, reply + cut, length - cut) == 0); /* the end of one, */
        assert_true(scans(&parser, reply, length) == 1);
        assert_true(scans(&parser, reply, cut) == 0); /* the beginning of one: lost with the next at most */
        scans(&parser, reply, length);
        assert_true(scans(&parser, reply, length) == 1);
    }
}

/* --- the block --- */

static const char *const_reply(uint32_t first, uint32_t second)
{
    return reply_of(&(struct urg_request){44, 45, 0, 1, 3, true}, 1500, (const uint32_t[]){first, second}, 2);
}

static void begin_streaming(const struct line *line)
{
    assert_true(line_hears(line, "QT\n"));
    line_say(line, "QT\n00P\n\n");
    assert_true(line_hears(line, "SCIP2.0\n"));
    line_say(line, "SCIP2.0\n0Ee\n\n");
    assert_true(line_hears(line, "BM\n"));
    line_say(line, "BM\n00P\n\n");
    assert_true(line_hears(line, "MD0044004501000\n"));
    line_say(line, "MD0044004501000\n00P\n\n");
}

static void gives_metres_and_marks_errors(void **state)
{
    (void)state;
    struct line line = line_create();
    struct fl_block *laser = testbed_block("urg", "device", line.path, "last_step", "45", "timeout", "60", NULL);
    testbed_begin(laser);
    const double *ranges = testbed_output(laser, "ranges");
    assert_true(isnan(ranges[0]) && isnan(ranges[1]));
    begin_streaming(&line);
    line_say(&line, const_reply(20, 5600));
    STEP_UNTIL(laser, GET(laser, "flag", bool));
    assert_near(ranges[0], 0.020, 1e-12);
    assert_near(ranges[1], 5.600, 1e-12);
    assert_near(GET(laser, "timestamp", double), 1.5, 1e-12);
    line_say(&line, const_reply(19, 5601));
    steps_under_seccomp(laser, 3);
    STEP_UNTIL(laser, GET(laser, "sequence", uint32_t) == 2);
    assert_true(isnan(ranges[0]) && isnan(ranges[1]));
    laser->type->terminate(laser);
    assert_true(line_hears(&line, "QT\n"));
    testbed_end(laser);
    line_unplug(&line);
}

static void gives_single_and_zero_by_polling(void **state)
{
    (void)state;
    struct line line = line_create();
    struct fl_block *laser = testbed_block("urg", "device", line.path, "last_step", "45", "timeout", "60", "precision",
                                           "single", "invalid", "zero", "mode", "poll", "characters", "2", NULL);
    testbed_begin(laser);
    const float *ranges = testbed_output(laser, "ranges");
    for (uint32_t count = 1; count < 4; count++) {
        assert_true(line_hears(&line, "GS0044004501\n"));
        line_say(&line,
                 reply_of(&(struct urg_request){44, 45, 0, 1, 2, false}, 1, (const uint32_t[]){0, 4000 + count}, 2));
        STEP_UNTIL(laser, GET(laser, "sequence", uint32_t) == count);
        assert_near((double)ranges[0], 0, 0);
        assert_near((double)ranges[1], 4 + count / 1000.0, 1e-6);
    }
    assert_true(GET(laser, "flag", bool));
    testbed_end(laser);
    line_unplug(&line);
}

static void begins_anew_after_silence_and_unplugging(void **state)
{
    (void)state;
    struct line line = line_create();
    struct fl_block *laser = testbed_block("urg", "device", line.path, "last_step", "45", "timeout", "60", NULL);
    testbed_begin(laser);
    begin_streaming(&line);
    begin_streaming(&line); /* the scanner said nothing for half a second */
    line_say(&line, const_reply(100, 100));
    STEP_UNTIL(laser, GET(laser, "flag", bool));
    laser->release_ns = fl_now_ns() + 61 * INT64_C(1000000000);
    assert_int_equal(testbed_step(laser), FL_OK);
    assert_false(GET(laser, "flag", bool));
    assert_int_equal(line_step(laser), FL_OK);
    assert_true(GET(laser, "flag", bool));
    line_unplug(&line);
    STEP_UNTIL(laser, !GET(laser, "flag", bool));
    line_plug(&line);
    begin_streaming(&line);
    line_say(&line, const_reply(200, 200));
    STEP_UNTIL(laser, GET(laser, "flag", bool) && GET(laser, "ranges", double) > 0.15);
    testbed_end(laser);
    line_unplug(&line);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("urg", "device", "/dev/x", "first_step", "726", NULL), "before first_step"));
    assert_non_null(strstr(testbed_refusal("urg", "device", "/dev/x", "last_step", "9999", NULL), "9956 points"));
    assert_non_null(strstr(testbed_refusal("urg", "device", "/dev/x", "max_range", "0.01", NULL), "not longer"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(sums_as_published),
        cmocka_unit_test(asks_as_specified),
        cmocka_unit_test(decodes_as_published),
        cmocka_unit_test(reads_whole_scans),
        cmocka_unit_test(refuses_each_flipped_bit),
        cmocka_unit_test(refuses_other_replies),
        cmocka_unit_test(comes_back_after_garbage),
        cmocka_unit_test(gives_metres_and_marks_errors),
        cmocka_unit_test(gives_single_and_zero_by_polling),
        cmocka_unit_test(begins_anew_after_silence_and_unplugging),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
