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

/* From the specification; 0L and 0M are what newer scanners add (urg_stamped, hokuyolx). */
static const struct {
    const char *command, *first, *last, *meaning;
} meanings[] = {
    {"", "0A", "0A", "it cannot make an answer: switch it off and on"},
    {"", "0B", "0B", "its buffer is full, or a command came twice"},
    {"", "0I", "0I", "it waits for new firmware: send RS, or switch it off and on"},
    {"", "0L", "0L", "it found a fault of its own: see its manual"},
    {"", "0M", "0M", "its motor has not settled: wait"},
    {"BM", "01", "01", "its laser is faulty: see its manual"},
    {"", "04", "04", "last_step lies beyond its range: see its data sheet"},
    {"", "05", "05", "last_step lies before first_step"},
    {"", "10", "10", "its laser is off, or its state forbids it"},
    {"", "21", "49", "it stopped to look into a fault"},
    {"", "50", "97", "its laser or its motor is faulty: see its manual"},
    {"", "98", "98", "it goes on after a fault"},
};

const char *urg_meaning(const struct urg_reply *reply)
{
    static const char *const well[] = {"00", "99", "0"};
    for (size_t i = 0; i < sizeof well / sizeof well[0]; i++)
        if (strcmp(reply->status, well[i]) == 0)
            return NULL;
    if (strcmp(reply->echo, "BM") == 0 && strcmp(reply->status, "02") == 0)
        return NULL; /* the laser is lit already */
    for (size_t i = 0; i < sizeof meanings / sizeof meanings[0]; i++)
        if (strncmp(reply->echo, meanings[i].command, strlen(meanings[i].command)) == 0 &&
            strcmp(reply->status, meanings[i].first) >= 0 && strcmp(reply->status, meanings[i].last) <= 0)
            return meanings[i].meaning;
    return "it does not know the command";
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

static enum state take_echo(struct urg_parser *parser)
{
    memset(&parser->reply, 0, sizeof parser->reply);
    if (parser->length <= URG_COMMAND)
        memcpy(parser->reply.echo, parser->line, parser->length + 1u);
    parser->asked = *parser->command && strcmp(parser->line, parser->command) == 0;
    return STATUS;
}

static enum state take_status(struct urg_parser *parser)
{
    const char *data = parser->request.stream ? "99b" : "00P";
    if (parser->length == 1 || (parser->length == 3 && sound(parser)))
        memcpy(parser->reply.status, parser->line, parser->length == 1 ? 1 : 2);
    return parser->asked && strcmp(parser->line, data) == 0 ? TIME : IGNORING;
}

/* The empty line that ends a reply: whether it completed a scan. */
static bool take_end(struct urg_parser *parser)
{
    bool begun = parser->asked && strcmp(parser->reply.status, parser->request.stream ? "99" : "00") == 0;
    bool complete =
        parser->state == DATA && !parser->partial_characters && parser->scan.count == urg_points(&parser->request);
    if (parser->state != ECHO)
        parser->replies++;
    parser->reply.scan_lost = begun && !complete;
    return complete;
}

/* The next state after a line, whose end is not in it. */
static enum state take_line(struct urg_parser *parser)
{
    if (!parser->length)
        return ECHO;
    switch ((enum state)parser->state) {
    case ECHO:
        return take_echo(parser);
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
        if (parser->length < URG_LINE && byte) {
            parser->line[parser->length++] = (char)byte;
            return false;
        }
        if (parser->state == ECHO) {
            memset(&parser->reply, 0, sizeof parser->reply);
            parser->asked = false;
        }
        parser->state = IGNORING;
        return false;
    }
    parser->line[parser->length] = '\0';
    bool complete = !parser->length && take_end(parser);
    if (complete)
        *scan = parser->scan;
    parser->state = (uint8_t)take_line(parser);
    parser->length = 0;
    return complete;
}
