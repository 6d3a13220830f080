/* What a PNI CommBoard with a MicroMag3 sends. PNI Legacy CommBoard user manual, "Standard data output modes". */
#ifndef FLOTILLA_MICROMAG3_FRAME_H
#define FLOTILLA_MICROMAG3_FRAME_H

#include "record.h"

enum { MICROMAG3_HEADING = 1 << 0, MICROMAG3_FIELD = 1 << 1 };
enum { MICROMAG3_ANSWER = 15 };

struct micromag3_sample {
    double heading;   /* degrees */
    double field[3];  /* z is 0 where the record has none: the board sends it in raw mode only, and not all have it */
    uint16_t error;   /* 0: none */
    uint8_t contains; /* MICROMAG3_HEADING, MICROMAG3_FIELD: which of them the record has */
};

struct micromag3_parser {
    struct record record;
    bool any_checksum;                 /* take records whatever their checksum, as the manual's own example needs it */
    char answer[MICROMAG3_ANSWER + 1]; /* the newest record that is no measurement, cut: the answer to a command */
};

bool micromag3_feed(struct micromag3_parser *parser, uint8_t byte, struct micromag3_sample *sample);

#endif
