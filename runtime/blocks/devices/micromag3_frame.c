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

/* Degrees have two decimals, 0 to 359.99; mils have none, 0 to 6399 (page 15). */
static bool in_degrees(const char *heading)
{
    return heading[strcspn(heading, ".XYZ:")] == '.';
}

/* [raw,][Chhh.hh][Xn][Yn][Zn][:Exxx]: what the board is configured to send, in this order, each at most once. */
static bool parse(const char *text, struct micromag3_sample *sample)
{
    enum { C = 1, X = 2, Y = 4, Z = 8, XY = X | Y };
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
    sample->contains = (uint8_t)((seen & C ? MICROMAG3_HEADING : 0) | ((seen & XY) == XY ? MICROMAG3_FIELD : 0));
    return sample->contains && sample->heading >= 0 && sample->heading < 360;
}

bool micromag3_feed(struct micromag3_parser *parser, uint8_t byte, struct micromag3_sample *sample)
{
    struct micromag3_sample read;
    struct record *record = &parser->record;
    if (!record_feed(record, byte, '*'))
        return false;
    if (!parser->any_checksum && !record_sound(record)) {
        record->reason = "a record's checksum is wrong: check the cable, or set checksum: none";
        return false;
    }
    const char *heading = *record->text == 'C' ? record->text + 1 : NULL;
    if (heading && *heading >= '0' && *heading <= '9' && !in_degrees(heading)) {
        record->reason = "the heading is in mils: the board did not take uc=d";
        return false;
    }
    if (!parse(record->text, &read)) {
        memcpy(parser->answer, record->text, MICROMAG3_ANSWER);
        parser->answer[MICROMAG3_ANSWER] = '\0';
        return false;
    }
    *sample = read;
    return true;
}
