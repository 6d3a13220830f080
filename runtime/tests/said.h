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

static inline struct said said_begin(void)
{
    struct said said = {memfd_create("said", MFD_CLOEXEC), dup(2)};
    assert_true(said.log >= 0 && said.error_output >= 0);
    assert_int_equal(dup2(said.log, 2), 2);
    return said;
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
}

#endif
