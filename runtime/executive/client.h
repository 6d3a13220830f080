/* The socket of a client of the tuner: waits end when the task ends, which `stop_fd` tells by being readable. */
#ifndef FLOTILLA_CLIENT_H
#define FLOTILLA_CLIENT_H

#include <poll.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    CLIENT_FOR_EVER = -1,
    CLIENT_MS = 2000, /* for a request to arrive, and for an answer to leave */
};

/* A deadline so long from now. */
int64_t client_deadline(int64_t milliseconds);

/* Wait until one of `waiting`, from the second on, is ready; the first is this function's own. False at the deadline
 * (CLIENT_FOR_EVER: none) and when the task ends. */
bool client_await(int stop_fd, struct pollfd *waiting, nfds_t count, int64_t deadline_ns);

/* Receive a line, without its end, of less than `size` bytes. False when none comes. */
bool client_receive(int stop_fd, int fd, char *line, size_t size);

/* Send all of the text; false when the client does not take it. */
bool client_send(int stop_fd, int fd, const char *text, size_t length);

#endif
