/* What blocks log while a test runs: the standard error, kept apart. Define _GNU_SOURCE before. */
#ifndef FLOTILLA_TEST_SAID_H
#define FLOTILLA_TEST_SAID_H

#include "testbed.h"

#include <stdlib.h>
#include <sys/mman.h>
#include <unistd.h>

struct said {
    int log, error_output;
};

static struct said said_now = {-1, -1}; /* begun and not ended */

/* A test that failed did not end it, and why it failed is in there, too. */
static inline void said_abandon(void)
{
    char all[16384];
    if (said_now.log < 0)
        return;
    ssize_t count = pread(said_now.log, all, sizeof all, 0);
    if (dup2(said_now.error_output, 2) < 0 || (count > 0 && write(2, all, (size_t)count) != count))
        abort();
    said_now.log = -1;
}

static inline struct said said_begin(void)
{
    said_abandon();
    atexit(said_abandon);
    said_now = (struct said){memfd_create("said", MFD_CLOEXEC), dup(2)};
    assert_true(said_now.log >= 0 && said_now.error_output >= 0);
    assert_int_equal(dup2(said_now.log, 2), 2);
    return said_now;
}

/* How often `text` was logged so far. */
static inline unsigned said_times(const struct said *said, const char *text)
{
    char all[16384];
    unsigned times = 0;
    ssize_t count = pread(said->log, all, sizeof all - 1, 0);
    assert_true(count >= 0 && (size_t)count < sizeof all - 1);
    all[count] = '\0';
    for (const char *at = all; (at = strstr(at, text)); at++)
        times++;
    return times;
}

static inline void said_end(const struct said *said)
{
    assert_int_equal(dup2(said->error_output, 2), 2);
    close(said->error_output);
    close(said->log);
    said_now.log = -1;
}

#endif
