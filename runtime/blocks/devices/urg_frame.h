/* SCIP 2.0, the protocol of Hokuyo's laser scanners. Communication protocol specification C-42-03320B. */
#ifndef FLOTILLA_URG_FRAME_H
#define FLOTILLA_URG_FRAME_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    URG_POINTS = 1536, /* no scanner with this protocol has more: the UXM-30LX-E's 1521 */
    URG_COMMAND = 15,  /* characters of the longest, MD */
    URG_BLOCK = 64,    /* characters of data in a line */
    URG_LINE = URG_BLOCK + 1,
};

/* What is asked for: steps `first` to `last`, `cluster` of them made one point. */
struct urg_request {
    uint16_t first, last, skip;  /* skip: scans between two that are sent */
    uint8_t cluster, characters; /* of a point: 2 (up to 4095 mm) or 3 */
    bool stream;                 /* MD or MS: scans without end; else GD or GS: one */
};

struct urg_scan {
    uint32_t timestamp; /* of the scanner, ms, 24 bits */
    uint16_t count;
    uint32_t millimetres[URG_POINTS]; /* short ones are error codes */
};

/* What a reply says of the command that it answers. */
struct urg_reply {
    char echo[URG_COMMAND + 1]; /* the command; empty of a longer line */
    char status[3];             /* two characters, one of SCIP 1.1, none with a wrong checksum */
    bool scan_lost;             /* a scan that was asked for, and lost */
};

/* What a status means, and what to do about it, as the answer to a SCIP 2.0 command. Static; NULL: no fault. */
const char *urg_meaning(const struct urg_reply *reply);

/* Points of a scan. */
uint16_t urg_points(const struct urg_request *request);

/* The command, without its line end, terminated by 0. */
void urg_command(const struct urg_request *request, char command[URG_COMMAND + 1]);

/* The character that ends a line of `count` others. */
char urg_checksum(const char *text, size_t count);

/* Replies are lines: the command's echo, a status, the time, blocks of data, nothing. All but the echo and the last end
 * with a checksum. Only scans that were asked for are taken: the echo must be the command, to the letter. */
struct urg_parser {
    struct urg_request request;
    char command[URG_COMMAND + 1]; /* empty: no scan is expected */
    char line[URG_LINE + 1];
    uint8_t length, state;
    uint8_t partial_characters; /* of a point that goes on in the next block */
    uint32_t partial;
    uint16_t replies;       /* complete ones of any kind, also refusals: counted up, and round */
    struct urg_reply reply; /* the newest of them, and what came since of the next */
    bool asked;             /* its echo is the command */
    struct urg_scan scan;
};

/* Expect scans of this request from here on. */
void urg_expect(struct urg_parser *parser, const struct urg_request *request);

bool urg_feed(struct urg_parser *parser, uint8_t byte, struct urg_scan *scan);

#endif
