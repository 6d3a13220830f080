#define _GNU_SOURCE
#include "client.h"

#include <errno.h>
#include <flotilla/block.h>
#include <string.h>
#include <sys/socket.h>

#define MILLISECOND_NS INT64_C(1000000)

int64_t client_deadline(int64_t milliseconds)
{
    return fl_now_ns() + milliseconds * MILLISECOND_NS;
}

bool client_await(int stop_fd, struct pollfd *waiting, nfds_t count, int64_t deadline_ns)
{
    waiting[0] = (struct pollfd){.fd = stop_fd, .events = POLLIN};
    for (;;) {
        int64_t left_ms = (deadline_ns - fl_now_ns() + MILLISECOND_NS - 1) / MILLISECOND_NS;
        int timeout_ms = deadline_ns == CLIENT_FOR_EVER ? -1
                                                        : (int)(left_ms < 0           ? 0
                                                                : left_ms < INT32_MAX ? left_ms
                                                                                      : INT32_MAX);
        int ready = poll(waiting, count, timeout_ms);
        if (ready >= 0 || errno != EINTR)
            return ready > 0 && !waiting[0].revents;
    }
}

bool client_receive(int stop_fd, int fd, char *line, size_t size)
{
    size_t used = 0;
    int64_t deadline_ns = client_deadline(CLIENT_MS);
    struct pollfd waiting[] = {{0}, {.fd = fd, .events = POLLIN}};
    while (client_await(stop_fd, waiting, 2, deadline_ns)) {
        ssize_t got = recv(fd, line + used, size - used, MSG_DONTWAIT);
        if (got <= 0)
            return false;
        char *end = memchr(line + used, '\n', (size_t)got);
        used += (size_t)got;
        if (end) {
            *end = '\0';
            return strlen(line) == (size_t)(end - line);
        }
        if (used == size)
            return false;
    }
    return false;
}

bool client_send(int stop_fd, int fd, const char *text, size_t length)
{
    int64_t deadline_ns = client_deadline(CLIENT_MS);
    struct pollfd waiting[] = {{0}, {.fd = fd, .events = POLLOUT}};
    while (length && client_await(stop_fd, waiting, 2, deadline_ns)) {
        ssize_t sent = send(fd, text, length, MSG_DONTWAIT | MSG_NOSIGNAL);
        if (sent < 0)
            return false;
        text += sent;
        length -= (size_t)sent;
    }
    return !length;
}
