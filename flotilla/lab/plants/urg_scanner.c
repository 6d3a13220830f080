/* A Hokuyo URG-04LX at a pseudo terminal, as over USB, which has no bit rate: SCIP 2.0 as far as the block urg needs
 * it, for plants in virtual time, where flotilla/lab/emulators/urg.py is too slow. Facts: communication protocol
 * specification for SCIP 2.0, C-42-03320B. It knows QT, BM, RS, TM2, MD and MS; all else it answers with status 0E. */
#define _GNU_SOURCE
#include "wheeled.h"

#include <errno.h>
#include <fcntl.h>
#include <flotilla/block.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <unistd.h>

enum { LINE = 32, BLOCK = 64, REPLY = 4096, COMMAND = 15 };

struct scanner {
    const char *link;
};

struct state {
    int fd; /* the scanner's end */
    bool plugged, streaming;
    char line[LINE + 1];
    size_t length;
    char command[COMMAND + 1]; /* by which it sends scans */
    uint32_t scans;
    char reply[REPLY];
    size_t reply_length;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct scanner, link, .summary = "symbolic link to the port that the robot opens, made here"),
};

enum { MILLIMETRES, SCANS, UNPLUGGED };
static const struct fl_port inputs[] = {
    {.name = "millimetres", .type = FL_UINT16, .width = WHEELED_STEPS, .unit = "mm", .summary = "the newest scan"},
    {.name = "scans", .type = FL_UINT32, .width = 1, .summary = "changes with each"},
    {.name = "unplugged", .type = FL_BOOLEAN, .width = 1, .flags = FL_OPTIONAL, .summary = "1: its port is gone"},
};

enum { SENT, LOST };
static const struct fl_port outputs[] = {
    {.name = "sent", .type = FL_UINT32, .width = 1, .summary = "scans"},
    {.name = "lost", .type = FL_UINT32, .width = 1, .summary = "answers for which the line had no room"},
};

/* --- the port --- */

static void unplug(struct fl_block *block)
{
    const struct scanner *set = block->parameters;
    struct state *state = block->state;
    if (!state->plugged)
        return;
    unlink(set->link);
    close(state->fd);
    state->plugged = false;
}

static int plug(struct fl_block *block)
{
    const struct scanner *set = block->parameters;
    struct state *state = block->state;
    struct termios raw;
    char name[64];
    state->fd = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (state->fd < 0)
        return fl_fail(block, "no pseudo terminal: %s", strerror(errno));
    state->plugged = true;
    state->streaming = false;
    state->length = 0;
    unlink(set->link);
    if (grantpt(state->fd) < 0 || unlockpt(state->fd) < 0 || ptsname_r(state->fd, name, sizeof name) != 0 ||
        tcgetattr(state->fd, &raw) < 0)
        return fl_fail(block, "the pseudo terminal cannot be set up: %s", strerror(errno));
    cfmakeraw(&raw);
    if (tcsetattr(state->fd, TCSANOW, &raw) < 0 || symlink(name, set->link) < 0)
        return fl_fail(block, "%s: %s", set->link, strerror(errno));
    return FL_OK;
}

/* --- answers --- */

static void say(struct state *state, const char *text, size_t length)
{
    if (state->reply_length + length > REPLY)
        return;
    memcpy(state->reply + state->reply_length, text, length);
    state->reply_length += length;
}

/* A line with its checksum. */
static void say_line(struct state *state, const char *text, size_t length)
{
    unsigned sum = 0;
    for (size_t i = 0; i < length; i++)
        sum += (uint8_t)text[i];
    say(state, text, length);
    say(state, (const char[]){(char)((sum & 0x3F) + 0x30), '\n'}, 2);
}

static void answer(struct state *state, const char *echo, const char *status)
{
    say(state, echo, strlen(echo));
    say(state, "\n", 1);
    say_line(state, status, strlen(status));
}

static void flush(struct fl_block *block, struct state *state)
{
    if (state->reply_length && write(state->fd, state->reply, state->reply_length) != (ssize_t)state->reply_length)
        FL_OUT(block, LOST, uint32_t)++;
    state->reply_length = 0;
}

static size_t encode(char *text, uint32_t number, size_t characters)
{
    for (size_t i = 0; i < characters; i++)
        text[i] = (char)((number >> (6 * (characters - 1 - i)) & 0x3F) + 0x30);
    return characters;
}

static unsigned number_in(const char *text, size_t characters)
{
    unsigned number = 0;
    for (size_t i = 0; i < characters; i++)
        number = 10 * number + (unsigned)(text[i] - '0');
    return number;
}

static void send_scan(struct fl_block *block, struct state *state)
{
    const uint16_t *millimetres = block->in[MILLIMETRES];
    const char *command = state->command;
    unsigned first = number_in(command + 2, 4), last = number_in(command + 6, 4), cluster = number_in(command + 10, 2);
    size_t characters = command[1] == 'S' ? 2 : 3, used = 0;
    char text[3 * WHEELED_STEPS + BLOCK], time[4];
    cluster = cluster ? cluster : 1;
    for (unsigned at = first; at <= last; at += cluster) {
        uint32_t shortest = 0;
        for (unsigned step = at; step < at + cluster && step <= last; step++) {
            bool there = step >= WHEELED_FIRST && step <= WHEELED_LAST;
            uint32_t range = there ? millimetres[step - WHEELED_FIRST] : 0;
            if (range >= 20 && (!shortest || range < shortest))
                shortest = range;
        }
        uint32_t most = (1u << 6 * characters) - 1;
        used += encode(text + used, shortest < most ? shortest : most, characters);
    }
    answer(state, command, "99");
    encode(time, (uint32_t)(block->release_ns / 1000000) & 0xFFFFFF, sizeof time);
    say_line(state, time, sizeof time);
    for (size_t at = 0; at < used; at += BLOCK)
        say_line(state, text + at, used - at < BLOCK ? used - at : BLOCK);
    say(state, "\n", 1);
    flush(block, state);
    FL_OUT(block, SENT, uint32_t)++;
}

static bool scan_command(const char *line)
{
    size_t length = strlen(line);
    if (length != COMMAND || line[0] != 'M' || (line[1] != 'D' && line[1] != 'S') ||
        strspn(line + 2, "0123456789") != COMMAND - 2)
        return false;
    return number_in(line + 2, 4) <= number_in(line + 6, 4) && number_in(line + 6, 4) < WHEELED_LAST + WHEELED_FIRST;
}

static void obey(struct state *state)
{
    const char *line = state->line;
    if (scan_command(line)) {
        memcpy(state->command, line, sizeof state->command);
        state->streaming = true;
        answer(state, line, "00");
    } else if (strcmp(line, "QT") == 0 || strcmp(line, "RS") == 0) {
        state->streaming = false;
        answer(state, line, "00");
    } else {
        answer(state, line, strcmp(line, "BM") == 0 ? "00" : strcmp(line, "TM2") == 0 ? "03" : "0E");
    }
    say(state, "\n", 1);
}

static void hear(struct fl_block *block, struct state *state)
{
    char received[256];
    ssize_t count = read(state->fd, received, sizeof received); /* EIO while nobody has the other end open */
    for (ssize_t i = 0; i < count; i++) {
        char c = received[i];
        if (c != '\n' && c != '\r' && state->length < LINE)
            state->line[state->length++] = c;
        if ((c == '\n' || c == '\r') && state->length) {
            state->line[state->length] = '\0';
            state->length = 0;
            obey(state);
        }
    }
    flush(block, state);
}

/* --- the block --- */

static int step(struct fl_block *block)
{
    struct state *state = block->state;
    if (FL_IN(block, UNPLUGGED, uint8_t))
        unplug(block);
    else if (!state->plugged && plug(block) != FL_OK)
        return FL_FAILED;
    if (state->plugged)
        hear(block, state);
    bool fresh = FL_IN(block, SCANS, uint32_t) != state->scans;
    state->scans = FL_IN(block, SCANS, uint32_t);
    if (state->plugged && state->streaming && fresh)
        send_scan(block, state);
    return FL_OK;
}

FL_BLOCK(urg_scanner) = {
    .abi = FL_ABI,
    .name = "urg-scanner",
    .summary = "a URG-04LX at a pseudo terminal, the other end of the block urg",
    .source = "Hokuyo communication protocol specification for SCIP 2.0, C-42-03320B",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct scanner),
    .state_size = sizeof(struct state),
    .step = step,
    .terminate = unplug,
};
