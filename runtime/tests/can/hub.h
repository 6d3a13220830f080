/* The bus that udp_can.c connects to, as a test sees it: what a block sends is taken, and what the test puts reaches
 * all blocks. */
#ifndef FLOTILLA_TEST_HUB_H
#define FLOTILLA_TEST_HUB_H

#include "udp_can.c"

#include <arpa/inet.h>
#include <poll.h>
#include <stdio.h>

enum { HUB_CLIENTS = 8 };
static int hub_fd;
static struct sockaddr_in hub_clients[HUB_CLIENTS];
static size_t hub_count;
static char hub_link_path[32];

static void hub_open(void)
{
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    socklen_t size = sizeof address;
    char port[8];
    hub_fd = socket(AF_INET, SOCK_DGRAM, 0);
    assert_true(hub_fd >= 0);
    assert_int_equal(bind(hub_fd, (struct sockaddr *)&address, size), 0);
    assert_int_equal(getsockname(hub_fd, (struct sockaddr *)&address, &size), 0);
    snprintf(port, sizeof port, "%d", ntohs(address.sin_port));
    setenv("CAN_HUB", port, 1);
    hub_count = 0;
}

/* From now on can0 is as `state` says, which udp_can.c explains; empty: there is none. */
static void hub_link(const char *state)
{
    if (!*hub_link_path) {
        strcpy(hub_link_path, "/tmp/can_link_XXXXXX");
        int made = mkstemp(hub_link_path);
        assert_true(made >= 0);
        close(made);
        setenv("CAN_LINK", hub_link_path, 1);
    }
    char next[sizeof hub_link_path + 2];
    snprintf(next, sizeof next, "%s.n", hub_link_path);
    FILE *file = fopen(next, "w");
    assert_non_null(file);
    fputs(state, file);
    assert_int_equal(fclose(file), 0);
    assert_int_equal(rename(next, hub_link_path), 0);
}

static void hub_close(void)
{
    unsetenv("CAN_HUB");
    unsetenv("CAN_LINK");
    if (*hub_link_path)
        unlink(hub_link_path);
    *hub_link_path = '\0';
    close(hub_fd);
}

/* The next frame that a block has sent. False: there is none. What was sent on this computer is there at once. */
static bool hub_take(struct can_frame *frame)
{
    for (;;) {
        struct sockaddr_in from;
        socklen_t size = sizeof from;
        ssize_t count = recvfrom(hub_fd, frame, sizeof *frame, MSG_DONTWAIT, (struct sockaddr *)&from, &size);
        if (count < 0)
            return false;
        if (count == sizeof *frame)
            return true;
        assert_int_equal(count, 0);
        size_t known = 0;
        while (known < hub_count && hub_clients[known].sin_port != from.sin_port)
            known++;
        assert_true(known < HUB_CLIENTS);
        hub_clients[known] = from;
        hub_count = known == hub_count ? known + 1 : hub_count;
    }
}

/* Until a block has bound its socket to the interface. */
static void hub_await(void)
{
    enum { PATIENCE_MS = 30000 };
    struct pollfd waiting = {.fd = hub_fd, .events = POLLIN};
    assert_int_equal(poll(&waiting, 1, PATIENCE_MS), 1);
}

static void hub_put(const struct can_frame *frame)
{
    for (size_t i = 0; i < hub_count; i++)
        assert_int_equal(
            sendto(hub_fd, frame, sizeof *frame, 0, (struct sockaddr *)&hub_clients[i], sizeof hub_clients[i]),
            sizeof *frame);
}

#endif
