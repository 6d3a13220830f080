/* Bare UDP sockets on loopback: the other side of a block under test. */
#ifndef FLOTILLA_TESTS_LOOPBACK_H
#define FLOTILLA_TESTS_LOOPBACK_H

#include "testbed.h"

#include <arpa/inet.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/random.h>
#include <sys/socket.h>
#include <unistd.h>

static inline int bare(const char *address, uint16_t port)
{
    struct sockaddr_in local = {.sin_family = AF_INET, .sin_port = htons(port)};
    int fd = socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    assert_int_equal(inet_pton(AF_INET, address, &local.sin_addr), 1);
    assert_int_equal(bind(fd, (struct sockaddr *)&local, sizeof local), 0);
    return fd;
}

static inline uint16_t port_of(int fd)
{
    struct sockaddr_in local;
    socklen_t size = sizeof local;
    assert_int_equal(getsockname(fd, (struct sockaddr *)&local, &size), 0);
    return ntohs(local.sin_port);
}

/* As a parameter; valid until the next call. Below those that the kernel deals out to sockets that ask for any (ip(7),
 * ip_local_port_range), so that no other test gets it before it is used. */
static inline const char *free_port(void)
{
    enum { FIRST = 20000, PORTS = 32768 - FIRST, ATTEMPTS = 100 };
    static char text[8];
    struct sockaddr_in local = {.sin_family = AF_INET};
    bool free = false;
    for (int attempt = 0; attempt < ATTEMPTS && !free; attempt++) {
        uint16_t drawn;
        assert_int_equal(getrandom(&drawn, sizeof drawn, 0), sizeof drawn);
        local.sin_port = htons((uint16_t)(FIRST + drawn % PORTS));
        int fd = socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
        free = bind(fd, (struct sockaddr *)&local, sizeof local) == 0;
        close(fd);
    }
    assert_true(free);
    snprintf(text, sizeof text, "%u", ntohs(local.sin_port));
    return text;
}

static inline void send_unsettled(int fd, uint16_t port, const void *bytes, size_t count)
{
    struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons(port)};
    to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    assert_int_equal(sendto(fd, bytes, count, 0, (struct sockaddr *)&to, sizeof to), count);
}

/* Wait until what was sent before has arrived: a busy kernel may leave it to a thread. Loopback keeps the order of what
 * is sent on one processor, so a datagram of our own arrives after all of it. */
static inline void settle(void)
{
    char byte = 0;
    int fd = bare("127.0.0.1", 0);
    send_unsettled(fd, port_of(fd), &byte, 1);
    assert_int_equal(recv(fd, &byte, 1, 0), 1);
    close(fd);
}

static inline void send_to(int fd, const char *port, const void *bytes, size_t count)
{
    send_unsettled(fd, (uint16_t)atoi(port), bytes, count);
    settle();
}

/* For main(), before any is sent. */
static inline void stay_on_one_processor(void)
{
    cpu_set_t here;
    CPU_ZERO(&here);
    CPU_SET((size_t)sched_getcpu(), &here);
    sched_setaffinity(0, sizeof here, &here);
}

#endif
