#define _GNU_SOURCE
#include "blocks/devices/dsp3000_frame.h"
#include "line.h"
#include "said.h"
#include "seccomp.h"

#include <limits.h>
#include <math.h>

static const double DEGREE = 3.14159265358979323846 / 180;

/* --- text --- */

/* How many samples come of a text; the last is in `sample`. */
static unsigned text_samples(const char *bytes, struct dsp3000_sample *sample)
{
    struct dsp3000_text text = {0};
    unsigned count = 0;
    for (; *bytes; bytes++)
        count += dsp3000_text_feed(&text, (uint8_t)*bytes, sample);
    return count;
}

static void reads_text(void **state)
{
    (void)state;
    struct dsp3000_sample sample;
    assert_int_equal(text_samples("     -12.345678   1\r\n", &sample), 1);
    assert_near(sample.degrees, -12.345678, 1e-12);
    assert_true(sample.valid);
    assert_int_equal(text_samples("     123.000001   0\r\n", &sample), 1);
    assert_near(sample.degrees, 123.000001, 1e-12);
    assert_false(sample.valid);
}

static void refuses_other_text(void **state)
{
    (void)state;
    struct dsp3000_sample sample;
    static const char *const wrong[] = {
        "\r\n",
        "12.345678 1\n",
        "12.345678 1\r",
        "12.345678\r\n",
        "12.3456781\r\n",
        "12.345678 2\r\n",
        "12.345678 1 1\r\n",
        "12.34567 1\r\n",
        "12.3456789 1\r\n",
        "1234.567890 1\r\n",
        ".567890 1\r\n",
        "-.567890 1\r\n",
        "--1.567890 1\r\n",
        "+1.567890 1\r\n",
        "1e1.567890 1\r\n",
        "1.567890. 1\r\n",
        "12345678 1\r\n",
        "                       12.345678 1\r\n",
        "garbage\r\n",
        /* These have 21 bytes. */
        "    1234.567890   1\r\n",
        "        .567890   1\r\n",
        "       -.567890   1\r\n",
        "     --1.567890   1\r\n",
        "      +1.567890   1\r\n",
        "     1e1.567890   1\r\n",
        "      01.567890   1\r\n",
        "      1 .567890   1\r\n",
        "     - 1.567890   1\r\n",
        "       12345678   1\r\n",
        "      1.5678901   1\r\n",
        "       1.567890   2\r\n",
        "       1.567890  11\r\n",
        "       1.567890 1  \r\n",
        "      12.567890  1 \r\n",
    };
    for (size_t i = 0; i < sizeof wrong / sizeof wrong[0]; i++)
        if (text_samples(wrong[i], &sample))
            fail_msg("accepted: %s", wrong[i]);
}

/* --- a stream of text in which one byte is wrong --- */

static const struct dsp3000_sample measured[] = {
    {.degrees = 0.015733, .valid = true},   {.degrees = -12.5, .valid = true},
    {.degrees = 12.5, .valid = true},       {.degrees = -0.000123, .valid = true},
    {.degrees = 374.999999, .valid = true}, {.degrees = -374.999999, .valid = true},
    {.degrees = 100, .valid = true},        {.degrees = -7.25, .valid = false},
    {.degrees = 0, .valid = true},          {.degrees = -90.010203, .valid = true},
};
enum { MEASURED = sizeof measured / sizeof measured[0], FRAME = 21, STREAM = MEASURED * FRAME };

/* Feed `count` bytes. How many frames of it are good although they were not sent so, or in another order; fails where
 * more than two frames of the stream are lost. */
static unsigned wrong_frames(const char *bytes, size_t count)
{
    struct dsp3000_text text = {0};
    struct dsp3000_sample sample;
    unsigned wrong = 0, right = 0;
    for (size_t at = 0, next = 0; at < count; at++) {
        if (!dsp3000_text_feed(&text, (uint8_t)bytes[at], &sample))
            continue;
        size_t match = next;
        while (match < MEASURED &&
               (fabs(measured[match].degrees - sample.degrees) > 1e-9 || measured[match].valid != sample.valid))
            match++;
        if (match < MEASURED) {
            next = match + 1;
            right++;
        } else {
            wrong += sample.valid;
        }
    }
    assert_true(right + 2 >= MEASURED);
    return wrong;
}

/* -12.5 became +12.5, with a flag of 1. What a format without a checksum cannot show is counted. */
static void no_single_wrong_byte_gives_a_wrong_value_that_the_format_can_show(void **state)
{
    (void)state;
    char stream[STREAM + 1], damaged[STREAM + 2];
    for (size_t i = 0; i < MEASURED; i++)
        assert_int_equal(
            snprintf(stream + i * FRAME, FRAME + 1, "%15.6f   %d\r\n", measured[i].degrees, measured[i].valid), FRAME);
    assert_int_equal(wrong_frames(stream, STREAM), 0);
    unsigned lost = 0, doubled = 0, flipped = 0, changed = 0;
    for (size_t at = 0; at < STREAM; at++) {
        memcpy(damaged, stream, at);
        memcpy(damaged + at, stream + at + 1, STREAM - at - 1);
        lost += wrong_frames(damaged, STREAM - 1);

        memcpy(damaged, stream, at + 1);
        memcpy(damaged + at + 1, stream + at, STREAM - at);
        doubled += wrong_frames(damaged, STREAM + 1);

        memcpy(damaged, stream, STREAM);
        for (unsigned mask = 1; mask < 256; mask++) {
            damaged[at] = (char)((unsigned char)stream[at] ^ mask);
            bool one_bit = !(mask & (mask - 1));
            unsigned wrong = wrong_frames(damaged, STREAM);
            changed += wrong;
            flipped += one_bit ? wrong : 0;
        }
    }
    assert_int_equal(lost, 0);
    assert_int_equal(doubled, 0);
    /* A digit that became another, a sign that became a digit or a space, a space that became a sign or a digit, and a
     * fault that became none: of 1680 flipped bits, and of 53550 changed bytes. */
    assert_int_equal(flipped, 242);
    assert_int_equal(changed, 709);
}

static void text_comes_back_after_garbage(void **state)
{
    (void)state;
    struct dsp3000_sample sample;
    assert_int_equal(text_samples("678 1\r\n\xff\xfe$%&\r\n       1.000000   1\r\n", &sample), 1);
    assert_int_equal(text_samples("       1.0000       2.000000   1\r\n       3.000000   1\r\n", &sample), 1);
    assert_near(sample.degrees, 3, 0);
    assert_int_equal(
        text_samples("this line is longer than any that the gyro sends 1.000000 1\r\n       4.000000   1\r\n", &sample),
        1);
    assert_near(sample.degrees, 4, 0);
}

static void tells_a_gap_in_text(void **state)
{
    (void)state;
    struct dsp3000_text text = {0};
    struct dsp3000_sample sample;
    static const struct {
        const char *said;
        bool gap;
    } lines[] = {
        {"678 1\r\n       1.000000   1\r\n", false}, /* of the first line nobody knows what it was */
        {"       1.000000   1\r\n", false},
        {"       1.00000   1\r\n\xff       1.000000   1\r\n       2.000000   1\r\n", true},
        {"       1.000000   1\r\n", false},
    };
    for (size_t i = 0; i < sizeof lines / sizeof *lines; i++) {
        bool given = false;
        for (const char *at = lines[i].said; *at; at++)
            given |= dsp3000_text_feed(&text, (uint8_t)*at, &sample);
        assert_true(given);
        assert_int_equal(sample.gap, lines[i].gap);
    }
}

/* --- words --- */

enum { SYNCHRONISATION = 1 };

static uint32_t word_of(bool valid, unsigned mode, int32_t content)
{
    uint32_t word = (uint32_t)valid << 31 | SYNCHRONISATION << 29 | mode << 27 | ((uint32_t)content & 0x3FFFFFF),
             ones = 0;
    for (unsigned bit = 0; bit < 32; bit++)
        ones += word >> bit & 1;
    return ones % 2 ? word : word | 1u << 26;
}

static bool feed_word(struct dsp3000_words *words, uint32_t word, struct dsp3000_sample *sample)
{
    unsigned samples = 0;
    for (int shift = 24; shift >= 0; shift -= 8)
        samples += dsp3000_words_feed(words, (uint8_t)(word >> shift), sample);
    assert_true(samples <= 1);
    return samples;
}

/* Its words count from the next on. */
static struct dsp3000_words trusting(unsigned mode)
{
    struct dsp3000_words words = {.mode = (uint8_t)mode};
    struct dsp3000_sample sample;
    for (int32_t i = 1; i <= DSP3000_TRUSTED; i++)
        assert_false(feed_word(&words, word_of(true, mode, 7 * i), &sample));
    return words;
}

/* Whether a word counts once the next one has come. */
static bool accepts(struct dsp3000_words *words, uint32_t word, struct dsp3000_sample *sample)
{
    feed_word(words, word, sample);
    return feed_word(words, word_of(true, words->mode, 7), sample);
}

static void reads_words(void **state)
{
    (void)state;
    struct dsp3000_sample sample;
    struct dsp3000_words rate = trusting(DSP3000_RATE), increment = trusting(DSP3000_INCREMENTAL),
                         angle = trusting(DSP3000_INTEGRATED);
    assert_true(feed_word(&rate, word_of(true, DSP3000_RATE, 1), &sample));
    assert_near(sample.degrees, 7 * DSP3000_TRUSTED * 60e-6, 1e-18);
    assert_true(sample.valid);
    assert_true(accepts(&rate, word_of(true, DSP3000_RATE, -6250000), &sample));
    assert_near(sample.degrees, -375, 1e-9);
    assert_true(accepts(&increment, word_of(true, DSP3000_INCREMENTAL, -50000), &sample));
    assert_near(sample.degrees, -0.3, 1e-12);
    assert_true(accepts(&angle, word_of(true, DSP3000_INTEGRATED, 30000000), &sample));
    assert_near(sample.degrees, 180, 1e-9);
    /* By hand: valid, rate, -1; 26 + 1 ones, so the parity bit stays 0 for an odd sum. */
    assert_true(accepts(&rate, 0x83FFFFFF, &sample));
    assert_near(sample.degrees, -60e-6, 1e-18);
}

static void a_fault_is_told_at_once(void **state)
{
    (void)state;
    struct dsp3000_sample sample;
    struct dsp3000_words words = trusting(DSP3000_RATE);
    assert_true(feed_word(&words, word_of(false, DSP3000_RATE, 5), &sample));
    assert_false(sample.valid);
    assert_false(feed_word(&words, word_of(true, DSP3000_RATE, 5), &sample)); /* what was before the fault is old */
    assert_true(feed_word(&words, word_of(true, DSP3000_RATE, 6), &sample));
    assert_true(sample.valid);
    assert_near(sample.degrees, 5 * 60e-6, 1e-18);
}

static void tells_a_gap_in_words(void **state)
{
    (void)state;
    const uint32_t word = word_of(true, DSP3000_INCREMENTAL, 5);
    struct dsp3000_sample sample;
    struct dsp3000_words words = trusting(DSP3000_INCREMENTAL);
    assert_true(accepts(&words, word, &sample));
    assert_false(sample.gap);
    feed_word(&words, word ^ 1, &sample);
    bool given = false;
    for (int i = 0; i < 2 * DSP3000_TRUSTED && !given; i++)
        given = feed_word(&words, word, &sample);
    assert_true(given);
    assert_true(sample.gap);
    assert_true(feed_word(&words, word, &sample));
    assert_false(sample.gap);
}

static void refuses_each_flipped_bit(void **state)
{
    (void)state;
    struct dsp3000_sample sample;
    for (unsigned bit = 0; bit < 32; bit++) {
        struct dsp3000_words words = trusting(DSP3000_RATE);
        if (accepts(&words, word_of(true, DSP3000_RATE, -1234567) ^ 1u << bit, &sample))
            fail_msg("accepted with bit %u flipped", bit);
    }
}

static void refuses_another_mode_and_the_impossible(void **state)
{
    (void)state;
    struct dsp3000_sample sample;
    struct dsp3000_words words = trusting(DSP3000_RATE);
    assert_false(accepts(&words, word_of(true, DSP3000_INCREMENTAL, 5), &sample));
    words = trusting(DSP3000_RATE);
    assert_false(accepts(&words, word_of(true, DSP3000_RATE, 7000001), &sample));
    words = trusting(DSP3000_INCREMENTAL);
    assert_false(accepts(&words, word_of(true, DSP3000_INCREMENTAL, -100001), &sample));
}

/* The words are a steady rate's, 90 degrees per second and some noise. Of one the second half is lost, of the next the
 * first, so that the halves of both stand where a word is expected. Half of these have the right parity; without a look
 * at the word after it 52 % of such accidents gave a wrong rate. */
static void bytes_lost_between_two_words_seldom_make_one(void **state)
{
    (void)state;
    enum { ACCIDENTS = 10000 };
    unsigned accidents = 0;
    for (int32_t noise = -ACCIDENTS / 2; noise < ACCIDENTS / 2; noise++) {
        struct dsp3000_sample sample;
        struct dsp3000_words words = {.mode = DSP3000_RATE};
        bool wrong = false;
        for (int32_t i = 0; i < 60; i++) {
            uint32_t word = word_of(true, DSP3000_RATE, 1500000 + noise + i * 37 % 100);
            for (int shift = 24; shift >= (i == 20 ? 16 : 0); shift -= 8)
                if (dsp3000_words_feed(&words, (uint8_t)(word >> shift), &sample) && sample.valid)
                    wrong |= fabs(sample.degrees - (1500000 + noise) * 60e-6) > 0.01;
        }
        accidents += wrong;
    }
    assert_int_equal(accidents, 142);
}

/* A byte that is lost or added shifts all that follows. No value may come that was not sent. */
static void words_come_back_after_a_slip(void **state)
{
    (void)state;
    for (unsigned slip = 0; slip < 8; slip++) {
        struct dsp3000_sample sample;
        struct dsp3000_words words = trusting(DSP3000_RATE);
        for (unsigned i = 0; i < slip; i++)
            dsp3000_words_feed(&words, (uint8_t)(0x95 * i + 0x81), &sample);
        unsigned good = 0;
        int32_t before = 7 * DSP3000_TRUSTED;
        for (int32_t i = 0; i < 40; i++) {
            int32_t content = 1000003 - 51001 * i;
            if (feed_word(&words, word_of(true, DSP3000_RATE, content), &sample)) {
                assert_near(sample.degrees, before * 60e-6, 1e-9);
                good++;
            }
            before = content;
        }
        assert_true(good >= 40 - 2 * DSP3000_TRUSTED - 1);
    }
}

/* Zeros on the line look right at every phase but for the valid bit; equal bytes do not distinguish the phases. */
static void does_not_trust_what_tells_nothing(void **state)
{
    (void)state;
    struct dsp3000_sample sample;
    for (unsigned byte = 0; byte < 256; byte++) {
        struct dsp3000_words words = {0};
        for (int i = 0; i < 1000; i++)
            assert_false(dsp3000_words_feed(&words, (uint8_t)byte, &sample));
    }
    /* Said again and again, this is a possible rate from its first byte on and from its second. */
    uint32_t ambiguous = word_of(true, DSP3000_RATE, -1839088);
    for (unsigned first = 0; first < 4; first++) {
        struct dsp3000_words words = {0};
        for (unsigned i = first; i < 400; i++)
            assert_false(dsp3000_words_feed(&words, (uint8_t)(ambiguous >> (24 - 8 * (i % 4))), &sample));
    }
}

/* --- the block --- */

static bool flag(struct fl_block *gyro)
{
    return GET(gyro, "flag", bool);
}

static void say_lines(const struct line *line, const char *text, int times)
{
    for (int i = 0; i < times; i++)
        line_say(line, text);
}

/* The command is said so often, and the lines that come before the gyro has surely changed its mode do not count. */
enum { REPEATS = 10, SETTLING = 2 };

static void gives_radians_and_sign(void **state)
{
    (void)state;
    static const struct {
        const char *positive;
        double sign;
    } cases[] = {{"clockwise", 1}, {"counterclockwise", -1}};
    for (size_t i = 0; i < 2; i++) {
        struct line line = line_create();
        struct fl_block *gyro =
            testbed_block("dsp3000", "device", line.path, "timeout", "60", "positive", cases[i].positive, NULL);
        testbed_begin(gyro);
        assert_int_equal(line_step(gyro), FL_OK);
        assert_false(flag(gyro));
        assert_true(line_receives(&line, "R"));
        for (int repeat = 1; repeat < REPEATS; repeat++) {
            say_lines(&line, "      90.000000   1\r\n", 1);
            assert_true(line_receives(&line, "R")); /* again, so it was read */
            assert_int_equal(line_step(gyro), FL_OK);
            assert_false(flag(gyro));
        }
        /* More where the machine was so busy that the gyro seemed silent. */
        STEP_UNTIL(gyro, (say_lines(&line, "      90.000000   1\r\n", 1), flag(gyro)));
        assert_true(GET(gyro, "sequence", uint32_t) >= REPEATS + SETTLING);
        assert_near(GET(gyro, "rate", double), cases[i].sign * 90 * DEGREE, 1e-12);
        testbed_end(gyro);
        line_unplug(&line);
    }
}

/* One line of a gyro that shows its angle, 90 degrees, until the command R number `misses` + 1 came; then it stands
 * still. Whether it has received that. */
static bool say_in_its_mode(const struct line *line, unsigned *received, unsigned misses)
{
    char commands[64];
    ssize_t count = read(line->master, commands, sizeof commands);
    for (ssize_t i = 0; i < count; i++)
        *received += commands[i] == 'R';
    line_say(line, *received > misses ? "       0.000000   1\r\n" : "      90.000000   1\r\n");
    return *received > misses;
}

/* Three missed commands left an angle that was given as a rate, for ever. */
static void makes_sure_of_the_mode(void **state)
{
    (void)state;
    struct line line = line_create();
    struct fl_block *gyro = testbed_block("dsp3000", "device", line.path, "timeout", "60", NULL);
    unsigned received = 0;
    testbed_begin(gyro);
    fcntl(line.master, F_SETFL, O_NONBLOCK);
    /* Each line waits for the command before it, or a driver that is late would find lines of the mode before. */
    struct pollfd command = {.fd = line.master, .events = POLLIN};
    STEP_UNTIL(gyro, (say_in_its_mode(&line, &received, REPEATS - 1), poll(&command, 1, received < REPEATS ? 1000 : 5),
                      flag(gyro)));
    assert_near(GET(gyro, "rate", double), 0, 0);
    /* Whatever changes it later: a short loss of power that no silence shows, or more misses than that. */
    STEP_UNTIL(gyro, (say_in_its_mode(&line, &received, UINT_MAX), GET(gyro, "rate", double) != 0));
    const unsigned before = received;
    STEP_UNTIL(gyro, say_in_its_mode(&line, &received, before));
    STEP_UNTIL(gyro, (say_in_its_mode(&line, &received, before), GET(gyro, "rate", double) == 0));
    assert_true(flag(gyro));
    testbed_end(gyro);
    line_unplug(&line);
}

static void says_what_is_wrong(void **state)
{
    (void)state;
    struct line line = line_create();
    struct said said = said_begin();
    struct fl_block *gyro = testbed_block("dsp3000", "device", line.path, NULL);
    testbed_begin(gyro);
    assert_true(line_receives(&line, "R"));
    line_say(&line, "  10.000000   1\r\n"); /* the first may have lost its beginning */
    line_say(&line, "      10.000000   1\r\n");
    line_say(&line, "  10.000000   1\r\n");
    AWAIT(said_times(&said, "a line is not the gyro's 21 bytes: check the cable and the format") == 1);
    line_say(&line, "      10.000000   0\r\n");
    AWAIT(said_times(&said, "the gyro reports a fault") == 1);
    line_say(&line, "     376.000000   1\r\n");
    AWAIT(said_times(&said, "the gyro reports a rate beyond full_scale") == 1);
    testbed_end(gyro);
    gyro = testbed_block("dsp3000", "device", line.path, "format", "words", NULL);
    testbed_begin(gyro);
    uint32_t word = word_of(true, DSP3000_INTEGRATED, 1234567);
    const uint8_t bytes[] = {(uint8_t)(word >> 24), (uint8_t)(word >> 16), (uint8_t)(word >> 8), (uint8_t)word};
    AWAIT((line_write(&line, bytes, sizeof bytes), said_times(&said, "the gyro sends words of another mode") == 1));
    testbed_end(gyro);
    line_unplug(&line);
    said_end(&said);
}

static void does_not_believe_faults_and_more_than_full_scale(void **state)
{
    (void)state;
    struct line line = line_create();
    struct fl_block *gyro = testbed_block("dsp3000", "device", line.path, "timeout", "60", NULL);
    testbed_begin(gyro);
    STEP_UNTIL(gyro, (line_say(&line, "      10.000000   1\r\n"), flag(gyro)));
    STEP_UNTIL(gyro, (line_say(&line, "      20.000000   0\r\n"), !flag(gyro)));
    assert_near(GET(gyro, "rate", double), 10 * DEGREE, 1e-12);
    STEP_UNTIL(gyro, (line_say(&line, "      30.000000   1\r\n"), flag(gyro)));
    STEP_UNTIL(gyro, (line_say(&line, "    -375.100000   1\r\n"), !flag(gyro)));
    assert_near(GET(gyro, "rate", double), 30 * DEGREE, 1e-12);
    STEP_UNTIL(gyro, (line_say(&line, "    -374.900000   1\r\n"), flag(gyro)));
    assert_near(GET(gyro, "rate", double), -374.9 * DEGREE, 1e-12);
    testbed_end(gyro);
    line_unplug(&line);
}

static void grows_stale(void **state)
{
    (void)state;
    struct line line = line_create();
    struct fl_block *gyro = testbed_block("dsp3000", "device", line.path, "timeout", "30", NULL);
    testbed_begin(gyro);
    STEP_UNTIL(gyro, (line_say(&line, "      10.000000   1\r\n"), flag(gyro)));
    gyro->release_ns = fl_now_ns() + 29 * INT64_C(1000000000) - gyro->period_ns;
    assert_int_equal(testbed_step(gyro), FL_OK);
    assert_true(flag(gyro));
    gyro->release_ns = fl_now_ns() + 31 * INT64_C(1000000000);
    assert_int_equal(testbed_step(gyro), FL_OK);
    assert_false(flag(gyro));
    assert_near(GET(gyro, "age", double), 31, 1);
    testbed_end(gyro);
    line_unplug(&line);
}

static void notices_unplugging_and_comes_back(void **state)
{
    (void)state;
    struct line line = line_create();
    struct fl_block *gyro = testbed_block("dsp3000", "device", line.path, "timeout", "60", NULL);
    testbed_begin(gyro);
    STEP_UNTIL(gyro, (line_say(&line, "      10.000000   1\r\n"), flag(gyro)));
    line_unplug(&line);
    STEP_UNTIL(gyro, !flag(gyro)); /* the value is far from stale */
    assert_true(GET(gyro, "age", double) < 50);
    line_plug(&line);
    STEP_UNTIL(gyro,
               (line_say(&line, "      11.000000   1\r\n"), flag(gyro) && GET(gyro, "rate", double) > 10.5 * DEGREE));
    testbed_end(gyro);
    line_unplug(&line);
}

static void counts_each_increment_once(void **state)
{
    (void)state;
    struct line line = line_create();
    struct fl_block *gyro = testbed_block("dsp3000", "device", line.path, "timeout", "60", "mode", "incremental", NULL);
    testbed_begin(gyro);
    STEP_UNTIL(gyro, (line_say(&line, "       0.000000   1\r\n"), flag(gyro)));
    assert_true(line_receives(&line, "A"));
    say_lines(&line, "       0.000000   1\r\n", 40);
    double sum = 0;
    say_lines(&line, "       0.125000   1\r\n", 40);
    STEP_UNTIL(gyro, (sum += GET(gyro, "increment", double)) > 39.5 * 0.125 * DEGREE);
    assert_near(sum, 40 * 0.125 * DEGREE, 1e-12);
    assert_true(flag(gyro));
    assert_int_equal(line_step(gyro), FL_OK);
    assert_near(GET(gyro, "increment", double), 0, 0);
    /* A line that came in pieces: the next step that has any says so, in its sum and its flag. */
    line_say(&line, "       0.12500");
    line_say(&line, "\r\n");
    STEP_UNTIL(gyro, (line_say(&line, "       0.125000   1\r\n"), !flag(gyro)));
    assert_near(GET(gyro, "increment", double), 0, 0);
    STEP_UNTIL(gyro, (line_say(&line, "       0.125000   1\r\n"), flag(gyro)));
    /* More than can wait: some are lost, and this step's angle with them. */
    STEP_UNTIL(gyro, (say_lines(&line, "       0.125000   1\r\n", 200), poll(NULL, 0, 20), !flag(gyro)));
    assert_near(GET(gyro, "increment", double), 0, 0);
    STEP_UNTIL(gyro, (line_say(&line, "       0.125000   1\r\n"), flag(gyro)));
    /* One that no gyro can have turned in 10 ms. */
    STEP_UNTIL(gyro, (line_say(&line, "       3.900000   1\r\n"), !flag(gyro)));
    assert_near(GET(gyro, "increment", double), 0, 0);
    steps_under_seccomp(gyro, 3); /* last: it takes so long that the gyro would seem silent */
    testbed_end(gyro);
    line_unplug(&line);
}

/* How often Z came since the last look. After a silence, which a busy computer makes, the mode comes in between. */
static int zeros_of(const struct line *line)
{
    int zeros = 0;
    for (char command; read(line->master, &command, 1) == 1;)
        zeros += command == 'Z';
    return zeros;
}

static void zeroes_the_angle(void **state)
{
    (void)state;
    struct line line = line_create();
    struct fl_block *gyro = testbed_block("dsp3000", "device", line.path, "timeout", "60", "mode", "integrated", NULL);
    testbed_begin(gyro);
    STEP_UNTIL(gyro, (line_say(&line, "     270.000000   1\r\n"), flag(gyro)));
    assert_true(line_receives(&line, "PPPPPPPPPP"));
    assert_near(GET(gyro, "angle", double), -90 * DEGREE, 1e-12);
    SET(gyro, "zero", bool, true);
    steps_under_seccomp(gyro, 3);
    fcntl(line.master, F_SETFL, O_NONBLOCK);
    int zeros = 0;
    STEP_UNTIL(gyro, (line_say(&line, "     270.000000   1\r\n"), (zeros += zeros_of(&line)) >= 3));
    /* It stays 1, and was sent three times, not more. */
    uint32_t before = GET(gyro, "sequence", uint32_t);
    STEP_UNTIL(gyro, (line_say(&line, "     270.000000   1\r\n"), GET(gyro, "sequence", uint32_t) > before + 10));
    /* Again and again: the first lines after a silence do not count. */
    STEP_UNTIL(gyro, (line_say(&line, "       0.000000   1\r\n"), fabs(GET(gyro, "angle", double)) < 1e-12));
    SET(gyro, "zero", bool, false);
    assert_int_equal(line_step(gyro), FL_OK);
    assert_int_equal(zeros + zeros_of(&line), 3);
    testbed_end(gyro);
    line_unplug(&line);
}

static void speaks_words_too(void **state)
{
    (void)state;
    struct line line = line_create();
    struct fl_block *gyro = testbed_block("dsp3000", "device", line.path, "format", "words", "timeout", "60", NULL);
    testbed_begin(gyro);
    AWAIT((line_write(&line, (const uint8_t[]){0x83, 0xFF, 0xFF, 0xFF}, 4), line_step(gyro), flag(gyro)));
    assert_near(GET(gyro, "rate", double), -60e-6 * DEGREE, 1e-15);
    testbed_end(gyro);
    line_unplug(&line);
}

static void write_word(const struct line *line, uint32_t word, int first, int count)
{
    const uint8_t bytes[] = {(uint8_t)(word >> 24), (uint8_t)(word >> 16), (uint8_t)(word >> 8), (uint8_t)word};
    line_write(line, bytes + first, (size_t)count);
}

/* Whether the driver says a command within so many milliseconds; takes it. */
static bool says(const struct line *line, int ms)
{
    char commands[64];
    struct pollfd waiting = {.fd = line->master, .events = POLLIN};
    return poll(&waiting, 1, ms) == 1 && read(line->master, commands, sizeof commands) > 0;
}

/* Switched off within a word, and on again: the halves of two words, each of about 90 degrees per second, make one of
 * 88.96. Where this computer was so busy that the driver noticed no silence, it is tried again. */
static void forgets_what_silence_broke_off(void **state)
{
    (void)state;
    enum { TRIES = 20, QUIET = 20 };
    const uint32_t word = word_of(true, DSP3000_RATE, 1500000), other = word_of(true, DSP3000_RATE, 1500001);
    const uint32_t halves = (word & 0xFFFF0000) | other >> 16;
    assert_int_equal(halves, word_of(true, DSP3000_RATE, (int32_t)(halves & 0x3FFFFFF)));
    struct line line = line_create();
    struct fl_block *gyro = testbed_block("dsp3000", "device", line.path, "format", "words", "timeout", "60", NULL);
    testbed_begin(gyro);
    bool noticed = false;
    for (int tries = 0; !noticed && tries < TRIES; tries++) {
        AWAIT((write_word(&line, word, 0, 4), line_step(gyro), flag(gyro)));
        int quiet = 0;
        AWAIT((write_word(&line, word, 0, 4), (quiet = says(&line, 2) ? 0 : quiet + 1) == QUIET));
        write_word(&line, word, 0, 2);
        poll(NULL, 0, 300);
        write_word(&line, other, 0, 2);
        write_word(&line, word, 0, 4);
        noticed = says(&line, 1000); /* its mode, once more */
    }
    assert_true(noticed);
    assert_int_equal(line_step(gyro), FL_OK);
    assert_near(GET(gyro, "rate", double), 90 * DEGREE, 0.01 * DEGREE);
    testbed_end(gyro);
    line_unplug(&line);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("dsp3000", NULL), "parameter device of dsp3000 is missing"));
    assert_non_null(strstr(testbed_refusal("dsp3000", "device", "/dev/x", "mode", "angle", NULL),
                           "angle is not one of rate|incremental|integrated"));
    assert_non_null(strstr(testbed_refusal("dsp3000", "device", "/dev/x", "baud", "100", NULL), "100 is outside 300"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(reads_text),
        cmocka_unit_test(refuses_other_text),
        cmocka_unit_test(no_single_wrong_byte_gives_a_wrong_value_that_the_format_can_show),
        cmocka_unit_test(text_comes_back_after_garbage),
        cmocka_unit_test(tells_a_gap_in_text),
        cmocka_unit_test(makes_sure_of_the_mode),
        cmocka_unit_test(says_what_is_wrong),
        cmocka_unit_test(reads_words),
        cmocka_unit_test(a_fault_is_told_at_once),
        cmocka_unit_test(tells_a_gap_in_words),
        cmocka_unit_test(refuses_each_flipped_bit),
        cmocka_unit_test(refuses_another_mode_and_the_impossible),
        cmocka_unit_test(bytes_lost_between_two_words_seldom_make_one),
        cmocka_unit_test(words_come_back_after_a_slip),
        cmocka_unit_test(does_not_trust_what_tells_nothing),
        cmocka_unit_test(gives_radians_and_sign),
        cmocka_unit_test(does_not_believe_faults_and_more_than_full_scale),
        cmocka_unit_test(grows_stale),
        cmocka_unit_test(notices_unplugging_and_comes_back),
        cmocka_unit_test(counts_each_increment_once),
        cmocka_unit_test(zeroes_the_angle),
        cmocka_unit_test(speaks_words_too),
        cmocka_unit_test(forgets_what_silence_broke_off),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
