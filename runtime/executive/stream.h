/* Clients of the tuner that watch signals while a task runs: a request, and then a row after each step until the client
 * goes, the rows asked for are there, or the task ends. Each has a thread of ordinary priority.
 */
#ifndef FLOTILLA_STREAM_H
#define FLOTILLA_STREAM_H

#include "scope.h"
#include "task.h"

#include <pthread.h>

enum { STREAM_SIGNALS = 32, STREAM_REQUEST_BYTES = 2048, STREAM_BEFORE_BYTES = 1 << 20 };

struct stream {
    bool begun;
    _Atomic bool ended; /* the thread is about to */
    pthread_t thread;
    int fd, stop_fd;
    char request[STREAM_REQUEST_BYTES]; /* the signals' names lie there */
    struct watched watched[STREAM_SIGNALS];
    size_t count;
    struct scope *scope;
    struct scope_slot *slot;
    struct sampler *sampler;
    uint64_t every, rows; /* `rows` left to send; 0: no end */
    bool csv;
    struct {
        bool wanted, below, is_past; /* `is_past`: the row before was on the far side of `value` already */
        size_t which;
        double value;
    } trigger;
    size_t before, held; /* rows to be held before the trigger, and how many are */
    size_t next, row_bytes;
    unsigned char *past; /* these rows, a circle */
};

struct streams {
    struct stream all[SCOPE_CLIENTS];
};

/* Begin what `request` asks for; the text after "watch ":
 *
 *     [every=N] [rows=N] [csv] [trigger=SIGNAL>VALUE [before=N]] SIGNAL...
 *
 *   SIGNAL   block.port, or block.port[element]
 *   every    only steps whose number is a multiple of N
 *   rows     end after so many; default 0, no end, or 1000 with a trigger
 *   csv      instead of lines of JSON; sampler.h describes both
 *   trigger  rows from the moment on at which the signal crosses VALUE upwards, or with < downwards, once `before` rows
 *            have been seen; these come first and count, so the row of the trigger is row `before`, from 0 on
 *
 * The stream owns the client's socket then. False with the reason. Signals of a client are at most STREAM_SIGNALS and
 * SCOPE_ROW_BYTES together. Call it in one thread.
 */
bool stream_begin(struct streams *streams, struct scope *scope, const struct task *task, int fd, int stop_fd,
                  const char *request, char *reason, size_t reason_size);

/* Wait for all threads, after `stop_fd` became readable. */
void streams_join(struct streams *streams);

#endif
