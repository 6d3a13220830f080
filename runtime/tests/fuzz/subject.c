#define _GNU_SOURCE
#include "subject.h"

#include "blocks/devices/dsp3000_frame.h"
#include "blocks/devices/micromag3_frame.h"
#include "blocks/devices/oceanserver_frame.h"
#include "blocks/devices/urg_frame.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define SOUND(text) .sound = (text), .sound_size = sizeof(text) - 1

/* --- what a stream ends with --- */

/* The last line, without its LF, which is the last byte; terminated by 0. Empty when it is too long. */
static const char *last_line(const uint8_t *bytes, size_t count)
{
    static char line[256];
    size_t begin = count - 1;
    while (begin && bytes[begin - 1] != '\n' && count - begin < sizeof line)
        begin--;
    memcpy(line, bytes + begin, count - 1 - begin);
    line[count - 1 - begin] = '\0';
    return line;
}

/* Whether the stream ends with $, text, `end`, the exclusive or of the text, and one byte more. */
static bool ends_with_record(const uint8_t *bytes, size_t count, char end)
{
    char claimed[3], computed[3];
    unsigned sum = 0;
    if (count < 5 || bytes[count - 4] != (uint8_t)end)
        return false;
    for (size_t at = count - 4; at > 0; at--) {
        uint8_t byte = bytes[at - 1];
        if (byte == '$') {
            snprintf(claimed, sizeof claimed, "%c%c", bytes[count - 3], bytes[count - 2]);
            snprintf(computed, sizeof computed, "%02X", sum & 0xFF);
            return strcmp(claimed, computed) == 0;
        }
        sum ^= byte;
    }
    return false;
}

/* --- DSP-3000 --- */

static struct dsp3000_text text;
static struct dsp3000_words words;
static struct dsp3000_sample turned;

static void begin_text(void)
{
    text = (struct dsp3000_text){0};
}

static bool feed_text(uint8_t byte)
{
    return dsp3000_text_feed(&text, byte, &turned);
}

/* There is no checksum, but the number must be the one of the line, to the C library too. */
static const char *wrong_text(const uint8_t *bytes, size_t count)
{
    double degrees;
    int valid;
    char rest;
    if (sscanf(last_line(bytes, count), " %lf %d %c", &degrees, &valid, &rest) != 2)
        return "not a line of the gyro";
    if (!(fabs(degrees - turned.degrees) < 1e-9) || valid != turned.valid)
        return "not the line's number";
    return fabs(turned.degrees) < 1000 ? NULL : "four digits";
}

static void begin_words(void)
{
    words = (struct dsp3000_words){0};
}

static bool feed_words(uint8_t byte)
{
    return dsp3000_words_feed(&words, byte, &turned);
}

/* A right word ends with the last byte. What is given is the word before it, which is right too; a fault at once. */
static const char *wrong_words(const uint8_t *bytes, size_t count)
{
    if (count < 4 * (DSP3000_TRUSTED + (size_t)turned.valid))
        return "trusted too early";
    const uint8_t *last = bytes + count - 4, *given = turned.valid ? last - 4 : last;
    for (const uint8_t *word = given; word <= last; word += 4) {
        unsigned ones = 0;
        for (unsigned bit = 0; bit < 32; bit++)
            ones += (uint32_t)word[bit / 8] >> bit % 8 & 1u;
        if (ones % 2 == 0)
            return "wrong parity";
        if (word[0] & 0x18)
            return "another mode";
        if (turned.valid != (word[0] >= 0x80))
            return "not the word's validity";
    }
    int32_t content = (given[0] & 3) << 24 | given[1] << 16 | given[2] << 8 | given[3];
    if (content >= 1 << 25)
        content -= 1 << 26;
    return fabs(content * 60e-6 - turned.degrees) < 1e-9 ? NULL : "not the word's number";
}

/* --- records --- */

static struct micromag3_parser compass;
static struct micromag3_sample pointed;
static struct record batteries;
static struct oceanserver_sample charged;

static void begin_compass(void)
{
    compass = (struct micromag3_parser){0};
}

static bool feed_compass(uint8_t byte)
{
    return micromag3_feed(&compass, byte, &pointed);
}

static const char *wrong_compass(const uint8_t *bytes, size_t count)
{
    if (!ends_with_record(bytes, count, '*'))
        return "wrong checksum";
    return pointed.heading >= 0 && pointed.heading < 360 &&
                   isfinite(pointed.field[0] + pointed.field[1] + pointed.field[2])
               ? NULL
               : "impossible";
}

static void begin_batteries(void)
{
    batteries = (struct record){0};
}

static bool feed_batteries(uint8_t byte)
{
    return oceanserver_feed(&batteries, byte, &charged);
}

static const char *wrong_batteries(const uint8_t *bytes, size_t count)
{
    if (!ends_with_record(bytes, count, '%'))
        return "wrong checksum";
    return charged.count <= OCEANSERVER_VALUES ? NULL : "too many values";
}

/* --- URG --- */

static const struct urg_request request = {44, 67, 0, 1, 3, true};
static struct urg_parser scanner;
static struct urg_scan scan;

static void begin_scanner(void)
{
    urg_expect(&scanner, &request);
}

static bool feed_scanner(uint8_t byte)
{
    return urg_feed(&scanner, byte, &scan);
}

/* The scan is written down again, and must be what was read: there is one way only to write it. */
static const char *wrong_scanner(const uint8_t *bytes, size_t count)
{
    enum { CHARACTERS = 24 * 3 };
    char data[CHARACTERS + 1] = "", expected[256];
    if (scan.count != 24)
        return "wrong number of points";
    for (unsigned i = 0; i < CHARACTERS; i++)
        data[i] = (char)(0x30 + (scan.millimetres[i / 3] >> (12 - 6 * (i % 3)) & 0x3F));
    char time[5] = {(char)(0x30 + (scan.timestamp >> 18 & 0x3F)), (char)(0x30 + (scan.timestamp >> 12 & 0x3F)),
                    (char)(0x30 + (scan.timestamp >> 6 & 0x3F)), (char)(0x30 + (scan.timestamp & 0x3F)), '\0'};
    int length = snprintf(expected, sizeof expected, "MD0044006701000\n99b\n%s%c\n%.64s%c\n%s%c\n\n", time,
                          urg_checksum(time, 4), data, urg_checksum(data, 64), data + 64,
                          urg_checksum(data + 64, CHARACTERS - 64));
    return (size_t)length <= count && memcmp(bytes + count - length, expected, (size_t)length) == 0
               ? NULL
               : "not what was sent";
}

/* --- all --- */

const struct subject subjects[] = {
    {.name = "dsp3000_text",
     SOUND("       0.000000   1\r\n     -12.345678   1\r\n     375.000000   0\r\n"),
     .begin = begin_text,
     .feed = feed_text,
     .wrong = wrong_text},
    {.name = "dsp3000_words",
     /* 0, 1, -1, 5, -2, 100000, 3, -3, 7, 9, 10, -11 times 60 µ°/s */
     SOUND("\x80\x00\x00\x00\x84\x00\x00\x01\x83\xFF\xFF\xFF\x80\x00\x00\x05\x87\xFF\xFF\xFE\x80\x01\x86\xA0"
           "\x80\x00\x00\x03\x87\xFF\xFF\xFD\x84\x00\x00\x07\x80\x00\x00\x09\x80\x00\x00\x0A\x83\xFF\xFF\xF5"),
     .begin = begin_words,
     .feed = feed_words,
     .wrong = wrong_words},
    {.name = "micromag3",
     SOUND("$C194.74X-106.00Y-403.00Z98.00:E200*6B\r\n$raw,X53Y-420Z0*3E\r\n$C0.00*5D\r\n$pollfreq=08*2A\r\n"),
     .begin = begin_compass,
     .feed = feed_compass,
     .wrong = wrong_compass},
    {.name = "oceanserver",
     SOUND("$S,01,270F,02,00,04,60%21\r\n$C1,01,FF,02,00,03,FF,04,00,05,00,06,00,07,00%72\r\n"
           "$B11,02,000A,01,0294,03,0080,08,0B94,09,4115,0A,FFEC,0B,FEC3%3D\r\n"),
     .begin = begin_batteries,
     .feed = feed_batteries,
     .wrong = wrong_batteries},
    {.name = "urg",
     SOUND("MD0044006701000\n00P\n\nMD0044006701000\n99b\nm2@0?\n"
           "1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1Dh1B\nDh1Dh1DhV\n\n"),
     .begin = begin_scanner,
     .feed = feed_scanner,
     .wrong = wrong_scanner},
};

const size_t subject_count = sizeof subjects / sizeof subjects[0];

size_t subject_run(const struct subject *subject, const uint8_t *bytes, size_t count)
{
    size_t measurements = 0;
    subject->begin();
    for (size_t at = 0; at < count; at++) {
        if (!subject->feed(bytes[at]))
            continue;
        measurements++;
        const char *wrong = subject->wrong(bytes, at + 1);
        if (wrong) {
            fprintf(stderr, "%s: after byte %zu: %s\n", subject->name, at, wrong);
            abort();
        }
    }
    return measurements;
}
