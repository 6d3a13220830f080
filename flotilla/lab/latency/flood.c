/* Sends bursts of one datagram, whose payload is in a file:
 *
 *   flood FROM TO PORT BURST INTERVAL_MS BURSTS FILE
 *
 * FROM and TO are IPv4 addresses, of which FROM is this computer's. It prints how many it sent. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>

enum { LONGEST = 1472, AT_ONCE = 1000 };

static struct sockaddr_in address(const char *text, const char *port)
{
    struct sockaddr_in found = {.sin_family = AF_INET, .sin_port = htons((uint16_t)atoi(port))};
    if (inet_pton(AF_INET, text, &found.sin_addr) != 1)
        exit(2);
    return found;
}

static int fail(const char *what)
{
    fprintf(stderr, "flood: %s: %s\n", what, strerror(errno));
    return 1;
}

int main(int count, char **arguments)
{
    static char payload[LONGEST];
    static struct mmsghdr messages[AT_ONCE];
    if (count != 8)
        return 2;
    struct sockaddr_in from = address(arguments[1], "0"), to = address(arguments[2], arguments[3]);
    int burst = atoi(arguments[4]), interval_ms = atoi(arguments[5]), bursts = atoi(arguments[6]);
    if (burst < 1 || burst > AT_ONCE || interval_ms < 1 || interval_ms > 999)
        return 2;
    FILE *file = fopen(arguments[7], "rb");
    if (!file)
        return fail(arguments[7]);
    struct iovec part = {payload, fread(payload, 1, LONGEST, file)};
    fclose(file);
    for (int i = 0; i < burst; i++)
        messages[i].msg_hdr =
            (struct msghdr){.msg_name = &to, .msg_namelen = sizeof to, .msg_iov = &part, .msg_iovlen = 1};
    int fd = socket(AF_INET, SOCK_DGRAM, 0);
    if (fd < 0 || bind(fd, (struct sockaddr *)&from, sizeof from) < 0)
        return fail("socket");
    struct timespec due;
    clock_gettime(CLOCK_MONOTONIC, &due);
    unsigned long sent = 0;
    while (bursts--) {
        int some = sendmmsg(fd, messages, (unsigned)burst, 0);
        sent += some > 0 ? (unsigned long)some : 0;
        due.tv_nsec += interval_ms * 1000000L;
        if (due.tv_nsec >= 1000000000) {
            due.tv_nsec -= 1000000000;
            due.tv_sec++;
        }
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
    }
    printf("%lu\n", sent);
    return 0;
}
