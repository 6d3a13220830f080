#include "oceanserver_frame.h"

#include "text.h"

static bool read_digit(const char **text, uint8_t *digit)
{
    if (**text < '1' || **text > '9')
        return false;
    *digit = (uint8_t)(*(*text)++ - '0');
    return true;
}

/* S, Cn or Bnm, then ",number,value" for each value. */
static bool parse(const char *text, struct oceanserver_sample *sample)
{
    *sample = (struct oceanserver_sample){0};
    char kind = *text++;
    if (kind == 'S')
        sample->kind = OCEANSERVER_SYSTEM;
    else if (kind == 'C' && read_digit(&text, &sample->controller))
        sample->kind = OCEANSERVER_CONTROLLER;
    else if (kind == 'B' && read_digit(&text, &sample->controller) && read_digit(&text, &sample->battery))
        sample->kind = OCEANSERVER_BATTERY;
    else
        return false;
    while (*text) {
        uint32_t number, value;
        if (sample->count == OCEANSERVER_VALUES || *text++ != ',' || !read_hexadecimal(&text, 2, &number) ||
            *text++ != ',' || !read_hexadecimal(&text, 4, &value))
            return false;
        sample->values[sample->count].number = (uint8_t)number;
        sample->values[sample->count++].value = (uint16_t)value;
    }
    return true;
}

bool oceanserver_value(const struct oceanserver_sample *sample, uint8_t number, uint16_t *value)
{
    for (uint8_t i = 0; i < sample->count; i++) {
        if (sample->values[i].number == number) {
            *value = sample->values[i].value;
            return true;
        }
    }
    return false;
}

bool oceanserver_feed(struct record *record, uint8_t byte, struct oceanserver_sample *sample)
{
    struct oceanserver_sample read;
    if (!record_feed(record, byte, '%') || !record_sound(record) || !parse(record->text, &read))
        return false;
    *sample = read;
    return true;
}
