#include "dsp3000_frame.h"

#include "text.h"

#include <string.h>

/* --- text --- */

/* "(-)xxx.xxxxxx y": the manual's two words, between any spaces. */
static bool parse(const char *line, struct dsp3000_sample *sample)
{
    double degrees;
    line += strspn(line, " ");
    const char *number = line;
    if (!read_decimal(&line, &degrees))
        return false;
    number += *number == '-';
    const char *point = memchr(number, '.', (size_t)(line - number));
    if (!point || line - point != 7 || point - number < 1 || point - number > 3)
        return false;
    size_t gap = strspn(line, " ");
    char valid = line[gap];
    if (!gap || (valid != '0' && valid != '1') || line[gap + 1 + strspn(line + gap + 1, " ")])
        return false;
    *sample = (struct dsp3000_sample){degrees, valid == '1'};
    return true;
}

bool dsp3000_text_feed(struct dsp3000_text *text, uint8_t byte, struct dsp3000_sample *sample)
{
    if (byte == '\n') {
        bool ended = !text->overlong && text->length && text->line[text->length - 1] == '\r';
        if (ended)
            text->line[text->length - 1] = '\0';
        text->length = 0;
        text->overlong = false;
        return ended && parse(text->line, sample);
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

/* Whether a gyro can say so at all. What it may say, but is beyond its full scale, is for the block to judge. */
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

/* Only this phase, and no other half as much: a gyro that says the same all the time may fit two. */
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
    if (!possible(words->window, words->mode)) {
        *trust = *trust > DSP3000_DISTRUST ? (uint8_t)(*trust - DSP3000_DISTRUST) : 0;
        return false;
    }
    /* A fault is reported at once, but no ground for trust: it would let zeros pass. */
    bool valid = words->window >> 31;
    if (valid && *trust < DSP3000_TRUSTED)
        ++*trust;
    if (!believed(words, phase))
        return false;
    double unit = words->mode == DSP3000_RATE ? 60e-6 : 6e-6;
    *sample = (struct dsp3000_sample){content(words->window) * unit, valid};
    return true;
}
