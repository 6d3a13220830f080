#include "micromag3_frame.h"

#include "text.h"

#include <string.h>

/* A value after its letter, once. */
static bool read_field(const char **text, uint8_t *seen, uint8_t bit, double *value)
{
    if (*seen & bit)
        return false;
    *seen |= bit;
    ++*text;
    return read_decimal(text, value);
}

/* [raw,][Chhh.hh][Xn][Yn][Zn][:Exxx]: what the board is configured to send, in this order, each at most once. */
static bool parse(const char *text, struct micromag3_sample *sample)
{
    enum { C = 1, X = 2, Y = 4, Z = 8, XYZ = X | Y | Z };
    uint8_t seen = 0;
    uint32_t error = 0;
    *sample = (struct micromag3_sample){0};
    if (strncmp(text, "raw,", 4) == 0)
        text += 4;
    while (*text && *text != ':') {
        bool good = *text == 'C'   ? read_field(&text, &seen, C, &sample->heading)
                    : *text == 'X' ? read_field(&text, &seen, X, &sample->field[0])
                    : *text == 'Y' ? read_field(&text, &seen, Y, &sample->field[1])
                    : *text == 'Z' ? read_field(&text, &seen, Z, &sample->field[2])
                                   : false;
        if (!good)
            return false;
    }
    if (*text && (*++text != 'E' || (text++, !read_hexadecimal(&text, 4, &error)) || *text))
        return false;
    sample->error = (uint16_t)error;
    sample->contains = (uint8_t)((seen & C ? MICROMAG3_HEADING : 0) | ((seen & XYZ) == XYZ ? MICROMAG3_FIELD : 0));
    return sample->contains && sample->heading >= 0 && sample->heading < 360;
}

bool micromag3_feed(struct micromag3_parser *parser, uint8_t byte, struct micromag3_sample *sample)
{
    struct micromag3_sample read;
    if (!record_feed(&parser->record, byte, '*') || !(parser->any_checksum || record_sound(&parser->record)))
        return false;
    if (!parse(parser->record.text, &read)) {
        parser->answers++;
        return false;
    }
    *sample = read;
    return true;
}
