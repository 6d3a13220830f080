/* The bus that udp_can.c connects to, as a test sees it: what a block sends is taken, and what the test puts reaches
 * all blocks. */
#ifndef FLOTILLA_TEST_HUB_H
#define FLOTILLA_TEST_HUB_H

#include "udp_can.c"

#include <arpa/inet.h>
#include <poll.h>
#include <stdio.h>

enum { HUB_CLIENTS = 4 };
static int hub_fd;
static struct sockaddr_in hub_clients[HUB_CLIENTS];
static size_t hub_count;

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

static void hub_close(void)
{
    unsetenv("CAN_HUB");
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
        assert_true(hub_count < HUB_CLIENTS);
        hub_clients[hub_count++] = from;
    }
}

static void hub_put(const struct can_frame *frame)
{
    for (size_t i = 0; i < hub_count; i++)
        assert_int_equal(
            sendto(hub_fd, frame, sizeof *frame, 0, (struct sockaddr *)&hub_clients[i], sizeof hub_clients[i]),
            sizeof *frame);
}

#endif
