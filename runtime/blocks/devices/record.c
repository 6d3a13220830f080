#include "record.h"

#include "text.h"

enum state { WAITING, TEXT, HIGH, LOW, END }; /* WAITING is 0: a zeroed record is ready */

bool record_feed(struct record *record, uint8_t byte, char end)
{
    /* A $ begins a record, wherever the one before was cut off. */
    if (byte == '$') {
        *record = (struct record){.state = TEXT, .reason = record->reason};
        return false;
    }
    int digit = hexadecimal((char)byte);
    switch ((enum state)record->state) {
    case WAITING:
        return false;
    case TEXT:
        if (byte == (uint8_t)end) {
            record->state = HIGH;
        } else if (byte < ' ' || byte > '~' || record->length == RECORD_TEXT) {
            record->state = WAITING;
        } else {
            record->text[record->length++] = (char)byte;
            record->text[record->length] = '\0';
            record->computed ^= byte;
        }
        return false;
    case HIGH:
        record->claimed = (uint8_t)((unsigned)digit << 4);
        record->state = digit < 0 ? WAITING : LOW;
        return false;
    case LOW:
        record->claimed |= (uint8_t)digit;
        record->state = digit < 0 ? WAITING : END;
        return false;
    case END: /* else a flipped bit that makes an end character would need only the two after it to fit */
        record->state = WAITING;
        return byte == '\r' || byte == '\n';
    }
    return false;
}
