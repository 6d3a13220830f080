/* What a KVH DSP-3000 gyro sends. Technical manual 54-0215 Rev. C: section 2.1 (text, 100 Hz), 3.1 (words, 1000 Hz). */
#ifndef FLOTILLA_DSP3000_FRAME_H
#define FLOTILLA_DSP3000_FRAME_H

#include <stdbool.h>
#include <stdint.h>

/* As the type bits of a word count them. */
enum dsp3000_mode { DSP3000_RATE, DSP3000_INCREMENTAL, DSP3000_INTEGRATED };

struct dsp3000_sample {
    double degrees; /* or degrees per second */
    bool valid;     /* the gyro's own judgement */
    bool gap;       /* before it one was refused or broken off, which an increment is missing with */
};

/* A frame of text has 21 bytes: the number "(-)xxx.xxxxxx" at the right of 15, three spaces, 0 or 1, CR LF
 * ("       0.015733   1" in the tests of ros-drivers/kvh_drivers). It has no checksum, but no byte of it can be lost or
 * doubled unseen. What stays unseen is a byte that changes into another that could stand there: a digit into a digit,
 * the sign into a space or a digit, a space before the number into a sign or a digit. */
enum { DSP3000_LINE = 20 }; /* without LF */

struct dsp3000_text {
    char line[DSP3000_LINE];
    uint8_t length;
    bool overlong; /* or not text: wait for the next line */
    bool lines;    /* there was one */
    bool gap;      /* since the last sample a line was not a frame; the caller sets it where one was broken off */
    bool wrong;    /* a line was not a frame, since the caller reset this */
    bool ended;    /* one came, likewise */
};

bool dsp3000_text_feed(struct dsp3000_text *text, uint8_t byte, struct dsp3000_sample *sample);

/* Words of four bytes, the most significant first, with nothing between them to mark where one begins: bit 31 valid,
 * 30-29 synchronisation, 28-27 mode, 26 odd parity of the whole, 25-0 two's complement. So all four alignments are
 * tried at once, and the one is used that has been right for some time while the others were not. Parity detects a
 * single wrong bit, but it is no checksum: one in eighty random words passes, and half of the words whose beginning and
 * end are of two others because bytes between them were lost. So a word counts once the next one is right, too, a
 * millisecond later. */
struct dsp3000_words {
    uint8_t mode;     /* enum dsp3000_mode that is expected: words of another are wrong */
    uint32_t window;  /* the last four bytes */
    uint8_t received; /* bytes, until there are four */
    uint8_t phase;    /* of the next byte */
    uint8_t trust[4]; /* by phase of the word's last byte */
    uint8_t other[4]; /* words of another mode in a row, likewise */
    bool wrong;       /* so many that the gyro is in another mode, since the caller reset this */
    bool gap;         /* since the last sample one was not right; the caller sets it where one was broken off */
    bool held;        /* `last` waits for the word after it */
    struct dsp3000_sample last;
};

enum {
    DSP3000_TRUSTED = 8, /* words in a row before one is used: 2^-8 by parity alone, and the values must be possible */
    DSP3000_OTHER = 64,  /* words of another mode in a row before it is reported: 2^-64 by parity alone */
    DSP3000_DISTRUST = 4 /* what a wrong word costs: after a single one the stream is back in four milliseconds */
};

/* Gives the word before, or at once a fault. */
bool dsp3000_words_feed(struct dsp3000_words *words, uint8_t byte, struct dsp3000_sample *sample);

#endif
