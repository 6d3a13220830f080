/* A serial line whose other end is the test: a pseudo terminal behind a link that stays when it is unplugged.
 * Define _GNU_SOURCE before. */
#ifndef FLOTILLA_TEST_LINE_H
#define FLOTILLA_TEST_LINE_H

#include "testbed.h"

#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

struct line {
    int master;
    char path[32]; /* what the block is given as its device */
};

static inline void line_plug(struct line *line)
{
    char slave[64];
    line->master = open("/dev/ptmx", O_RDWR | O_NOCTTY | O_CLOEXEC);
    assert_true(line->master >= 0);
    assert_int_equal(grantpt(line->master), 0);
    assert_int_equal(unlockpt(line->master), 0);
    assert_int_equal(ptsname_r(line->master, slave, sizeof slave), 0);
    assert_int_equal(symlink(slave, line->path), 0);
}

static inline void line_unplug(struct line *line)
{
    unlink(line->path);
    close(line->master);
    line->master = -1;
}

static inline struct line line_create(void)
{
    struct line line = {.master = -1, .path = "/tmp/flotilla-line.XXXXXX"};
    int unique = mkstemp(line.path);
    assert_true(unique >= 0);
    close(unique);
    unlink(line.path);
    line_plug(&line);
    return line;
}

static inline void line_write(const struct line *line, const void *bytes, size_t count)
{
    assert_int_equal(write(line->master, bytes, count), count);
}

static inline void line_say(const struct line *line, const char *text)
{
    line_write(line, text, strlen(text));
}

/* $, text, `end`, and the exclusive or of the text in hexadecimal; until the next call. */
static inline const char *line_record(const char *text, char end)
{
    static char record[256];
    unsigned sum = 0;
    for (const char *at = text; *at; at++)
        sum ^= (unsigned char)*at;
    snprintf(record, sizeof record, "$%s%c%02X\r\n", text, end, sum);
    return record;
}

/* Milliseconds until AWAIT is given up: far more than anything here takes, because the machine may be busy. */
enum { AWAIT_MS = 20 * 1000 };

static inline bool line_tick(int64_t begun_ns)
{
    poll(NULL, 0, 1);
    return (fl_now_ns() - begun_ns) / 1000000 < AWAIT_MS;
}

/* Wait for something that another thread brings about. */
#define AWAIT(condition)                                                                                               \
    for (int64_t begun_ns = fl_now_ns(); !(condition);)                                                                \
        if (!line_tick(begun_ns))                                                                                      \
    fail_msg("timeout: %s", #condition)

/* Read until `expected` has come, whatever else comes before it; false when it does not. */
static inline bool line_receives(const struct line *line, const char *expected)
{
    char received[4096];
    size_t count = 0, wanted = strlen(expected);
    while (count < sizeof received) {
        struct pollfd waiting = {.fd = line->master, .events = POLLIN};
        if (poll(&waiting, 1, AWAIT_MS) != 1 || read(line->master, received + count, 1) != 1)
            break;
        count++;
        if (count >= wanted && memcmp(received + count - wanted, expected, wanted) == 0)
            return true;
    }
    print_error("instead of %s came %.*s\n", expected, (int)count, received);
    return false;
}

/* One step now, as the executive would: the testbed's own clock runs ahead of the device's. */
static inline int line_step(struct fl_block *block)
{
    block->release_ns = fl_now_ns() - block->period_ns;
    return testbed_step(block);
}

/* Step until an output says so. */
#define STEP_UNTIL(block, condition) AWAIT((assert_int_equal(line_step(block), FL_OK), (condition)))

#endif
