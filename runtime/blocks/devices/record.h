/* Text records on a serial line: $, printable text, an end character, two hexadecimal digits that are the exclusive or
 * of the text, CR or LF. NMEA 0183's end character is *, OceanServer's %. */
#ifndef FLOTILLA_DEVICES_RECORD_H
#define FLOTILLA_DEVICES_RECORD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { RECORD_TEXT = 120 };

struct record {
    char text[RECORD_TEXT + 1]; /* between $ and the end character, terminated by 0 */
    uint8_t length;
    uint8_t state;
    uint8_t computed, claimed; /* checksums */
    const char *reason;        /* why the newest bad record was not used; NULL: none. For fl_serial_protocol.reason */
};

/* Take one byte of records that `end` ends. True when it completed one, its checksum still to be judged: the text is in
 * record->text then. */
bool record_feed(struct record *record, uint8_t byte, char end);

static inline bool record_sound(const struct record *record)
{
    return record->computed == record->claimed;
}

/* The reason, once. */
static inline const char *record_reason(struct record *record)
{
    const char *reason = record->reason;
    record->reason = NULL;
    return reason;
}

#endif
