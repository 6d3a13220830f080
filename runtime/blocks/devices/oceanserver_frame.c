#include "oceanserver_frame.h"

#include "text.h"

enum { COLLISION = 0xFFFF };

static bool read_digit(const char **text, uint8_t *digit)
{
    if (**text < '1' || **text > '9')
        return false;
    *digit = (uint8_t)(*(*text)++ - '0');
    return true;
}

/* Past the message, which may have commas of its own: the next value begins with a number of two digits. */
static const char *skip_message(const char *text)
{
    while (*text && !(text[0] == ',' && hexadecimal(text[1]) >= 0 && hexadecimal(text[2]) >= 0 && text[3] == ','))
        text++;
    return text;
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
            *text++ != ',')
            return false;
        if (sample->kind == OCEANSERVER_SYSTEM && number == OCEANSERVER_S_TEXT) {
            text = skip_message(text);
            continue;
        }
        if (!read_hexadecimal(&text, 4, &value))
            return false;
        sample->values[sample->count].number = (uint8_t)number;
        sample->values[sample->count++].value = (uint16_t)value;
    }
    return true;
}

/* Values that differ from a collision's. Others may be all ones: registers say "not charging" so. */
static const struct {
    uint8_t kind, number;
    uint16_t most;
} limits[] = {
    {OCEANSERVER_SYSTEM, OCEANSERVER_S_MINUTES, COLLISION - 1},
    {OCEANSERVER_SYSTEM, OCEANSERVER_S_CHARGE, 100},
    {OCEANSERVER_BATTERY, OCEANSERVER_B_TEMPERATURE, COLLISION - 1},
    {OCEANSERVER_BATTERY, OCEANSERVER_B_VOLTAGE, COLLISION - 1},
    {OCEANSERVER_BATTERY, OCEANSERVER_B_CURRENT, COLLISION - 1},
    {OCEANSERVER_BATTERY, OCEANSERVER_B_CHARGE, 100},
};

static bool collided(uint8_t kind, uint8_t number, uint16_t value)
{
    for (size_t i = 0; i < sizeof limits / sizeof limits[0]; i++)
        if (limits[i].kind == kind && limits[i].number == number)
            return value > limits[i].most;
    return false;
}

bool oceanserver_value(const struct oceanserver_sample *sample, uint8_t number, uint16_t *value)
{
    for (uint8_t i = 0; i < sample->count; i++) {
        if (sample->values[i].number == number) {
            *value = sample->values[i].value;
            return !collided(sample->kind, number, *value);
        }
    }
    return false;
}

bool oceanserver_feed(struct record *record, uint8_t byte, struct oceanserver_sample *sample)
{
    struct oceanserver_sample read;
    if (!record_feed(record, byte, '%'))
        return false;
    if (!record_sound(record)) {
        record->reason = "a record's checksum is wrong: check the cable";
        return false;
    }
    if (!parse(record->text, &read)) {
        record->reason = "a record that no battery controller sends: check what is connected";
        return false;
    }
    for (uint8_t i = 0; i < read.count; i++)
        if (collided(read.kind, read.values[i].number, read.values[i].value))
            record->reason = "a value reads FFFF, a collision on the controller's SMBus: the one before stays";
    *sample = read;
    return true;
}
