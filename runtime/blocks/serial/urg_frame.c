#include "urg_frame.h"

#include <stdio.h>
#include <string.h>

/* IGNORING lasts to the next empty line, the end of whatever reply it is. */
enum state { ECHO, STATUS, TIME, DATA, IGNORING };

uint16_t urg_points(const struct urg_request *request)
{
    return (uint16_t)((request->last - request->first) / request->cluster + 1);
}

void urg_command(const struct urg_request *request, char command[URG_COMMAND + 1])
{
    char what = request->characters == 2 ? 'S' : 'D';
    if (request->stream)
        snprintf(command, URG_COMMAND + 1, "M%c%04u%04u%02u%01u00", what, request->first % 10000u,
                 request->last % 10000u, request->cluster % 100u, request->skip % 10u);
    else
        snprintf(command, URG_COMMAND + 1, "G%c%04u%04u%02u", what, request->first % 10000u, request->last % 10000u,
                 request->cluster % 100u);
}

char urg_checksum(const char *text, size_t count)
{
    unsigned sum = 0;
    while (count--)
        sum += (unsigned char)*text++;
    return (char)((sum & 0x3F) + 0x30);
}

void urg_expect(struct urg_parser *parser, const struct urg_request *request)
{
    memset(parser, 0, sizeof *parser);
    parser->request = *request;
    urg_command(request, parser->command);
}

/* Whether the line ends with its checksum, and holds nothing but characters of six bits before it. */
static bool sound(const struct urg_parser *parser)
{
    unsigned count = parser->length;
    for (unsigned i = 0; i < count; i++)
        if (parser->line[i] < 0x30 || parser->line[i] > 0x6F)
            return false;
    return count >= 2 && urg_checksum(parser->line, count - 1) == parser->line[count - 1];
}

static uint32_t six_bits(char character)
{
    return (uint32_t)(character - 0x30);
}

static enum state take_time(struct urg_parser *parser)
{
    if (parser->length != 5 || !sound(parser))
        return IGNORING;
    parser->scan.timestamp = 0;
    for (int i = 0; i < 4; i++)
        parser->scan.timestamp = parser->scan.timestamp << 6 | six_bits(parser->line[i]);
    parser->scan.count = 0;
    parser->partial_characters = 0;
    parser->partial = 0;
    return DATA;
}

/* Characters of the scan that are still to come. */
static unsigned missing(const struct urg_parser *parser)
{
    unsigned points = urg_points(&parser->request);
    if (points > URG_POINTS)
        points = URG_POINTS;
    return (points - parser->scan.count) * (unsigned)parser->request.characters - parser->partial_characters;
}

/* A point may begin in one block and end in the next. All blocks but the last are full: a line that lost characters may
 * have a checksum that is right by chance, one of 64. */
static enum state take_block(struct urg_parser *parser)
{
    unsigned due = missing(parser) < URG_BLOCK ? missing(parser) : URG_BLOCK;
    if (!sound(parser) || parser->length != due + 1)
        return IGNORING;
    for (unsigned i = 0; i < due; i++) {
        parser->partial = parser->partial << 6 | six_bits(parser->line[i]);
        if (++parser->partial_characters < parser->request.characters)
            continue;
        parser->scan.millimetres[parser->scan.count++] = parser->partial;
        parser->partial_characters = 0;
        parser->partial = 0;
    }
    return DATA;
}

static enum state take_status(struct urg_parser *parser)
{
    const char *data = parser->request.stream ? "99b" : "00P";
    if (parser->length == 3 && memcmp(parser->line, data, 3) == 0)
        return TIME;
    return IGNORING;
}

/* The next state after a line, whose end is not in it. */
static enum state take_line(struct urg_parser *parser)
{
    if (!parser->length)
        return ECHO;
    switch ((enum state)parser->state) {
    case ECHO:
        return *parser->command && strcmp(parser->line, parser->command) == 0 ? STATUS : IGNORING;
    case STATUS:
        return take_status(parser);
    case TIME:
        return take_time(parser);
    case DATA:
        return take_block(parser);
    case IGNORING:
        break;
    }
    return IGNORING;
}

bool urg_feed(struct urg_parser *parser, uint8_t byte, struct urg_scan *scan)
{
    if (byte != '\n') {
        if (parser->length == URG_LINE || !byte)
            parser->state = IGNORING;
        else
            parser->line[parser->length++] = (char)byte;
        return false;
    }
    parser->line[parser->length] = '\0';
    bool complete = !parser->length && parser->state == DATA && !parser->partial_characters &&
                    parser->scan.count == urg_points(&parser->request);
    if (complete)
        *scan = parser->scan;
    if (!parser->length)
        parser->replies++;
    parser->state = (uint8_t)take_line(parser);
    parser->length = 0;
    return complete;
}
