#include "dsp3000_frame.h"

#include "text.h"

#include <stddef.h>
#include <string.h>

/* --- text --- */

/* Where a frame has what: the number's end, its point, and the digit of validity. */
enum { NUMBER = 15, POINT = 8, VALID = 18 };

/* "(-)xxx.xxxxxx", as wide as it need be, with spaces before it. */
static bool parse(const char *frame, struct dsp3000_sample *sample)
{
    const char *at = frame + strspn(frame, " ");
    const char *digits = at + (*at == '-');
    double degrees;
    if (!read_decimal(&at, &degrees) || at != frame + NUMBER || frame[POINT] != '.')
        return false;
    ptrdiff_t before = frame + POINT - digits;
    if (before < 1 || before > 3 || (before > 1 && *digits == '0'))
        return false;
    if (strspn(frame + NUMBER, " ") != VALID - NUMBER || (frame[VALID] != '0' && frame[VALID] != '1'))
        return false;
    *sample = (struct dsp3000_sample){.degrees = degrees, .valid = frame[VALID] == '1'};
    return true;
}

bool dsp3000_text_feed(struct dsp3000_text *text, uint8_t byte, struct dsp3000_sample *sample)
{
    if (byte == '\n') {
        bool whole = !text->overlong && text->length == DSP3000_LINE && text->line[DSP3000_LINE - 1] == '\r';
        bool good = false;
        if (whole) {
            text->line[DSP3000_LINE - 1] = '\0';
            good = parse(text->line, sample);
        }
        text->length = 0;
        text->overlong = false;
        if (good)
            sample->gap = text->gap;
        text->gap = !good && (text->gap || text->lines); /* of the first the beginning may be missing */
        text->wrong |= !good && text->lines;
        text->lines = true;
        text->ended = true;
        return good;
    }
    if (text->length == DSP3000_LINE || !byte)
        text->overlong = true;
    else
        text->line[text->length++] = (char)byte;
    return false;
}

/* --- words --- */

static bool odd_parity(uint32_t word)
{
    for (unsigned shift = 16; shift; shift /= 2)
        word ^= word >> shift;
    return word & 1;
}

static int32_t content(uint32_t word)
{
    uint32_t bits = word & 0x3FFFFFF;
    return bits & 0x2000000 ? (int32_t)(bits | 0xFC000000) : (int32_t)bits;
}

/* Whether the value is possible at all. Whether it is beyond full scale is for the block to check. */
static bool possible(uint32_t word, unsigned mode)
{
    static const int32_t most[] = {
        [DSP3000_RATE] = 7000000,        /* 420 °/s */
        [DSP3000_INCREMENTAL] = 100000,  /* 0.6° in a millisecond */
        [DSP3000_INTEGRATED] = 60000000, /* 360° */
    };
    int32_t value = content(word);
    return odd_parity(word) && (word >> 27 & 3) == mode && value >= -most[mode] && value <= most[mode];
}

/* Use this phase only if no other is half as good: a constant value may fit two phases. */
static bool believed(const struct dsp3000_words *words, unsigned phase)
{
    for (unsigned other = 0; other < 4; other++)
        if (other != phase && words->trust[other] >= DSP3000_TRUSTED / 2)
            return false;
    return words->trust[phase] >= DSP3000_TRUSTED;
}

bool dsp3000_words_feed(struct dsp3000_words *words, uint8_t byte, struct dsp3000_sample *sample)
{
    unsigned phase = words->phase;
    uint8_t *trust = &words->trust[phase];
    words->phase = (uint8_t)((phase + 1) % 4);
    words->window = words->window << 8 | byte;
    if (words->received < 4 && ++words->received < 4)
        return false;
    bool other = odd_parity(words->window) && words->window >> 31 && (words->window >> 27 & 3) != words->mode;
    words->other[phase] = !other ? 0 : words->other[phase] < DSP3000_OTHER ? words->other[phase] + 1 : DSP3000_OTHER;
    words->wrong |= words->other[phase] == DSP3000_OTHER;
    bool valid = words->window >> 31, right = possible(words->window, words->mode);
    bool used = *trust == DSP3000_TRUSTED; /* only such a phase's word is held */
    if (!right)
        *trust = *trust > DSP3000_DISTRUST ? (uint8_t)(*trust - DSP3000_DISTRUST) : 0;
    else if (valid && *trust < DSP3000_TRUSTED) /* if faults counted as right words, zeros would pass */
        ++*trust;
    if (!right || !believed(words, phase)) {
        words->held = words->held && !used;
        words->gap = words->gap || used;
        return false;
    }
    double unit = words->mode == DSP3000_RATE ? 60e-6 : 6e-6;
    struct dsp3000_sample now = {.degrees = content(words->window) * unit, .valid = valid};
    bool given = words->held || !valid;
    if (given) {
        *sample = valid ? words->last : now;
        sample->gap = words->gap;
        words->gap = false;
    }
    words->last = now;
    words->held = valid;
    return given;
}
