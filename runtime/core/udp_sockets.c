#define _GNU_SOURCE
#include "udp_sockets.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/netlink.h>
#include <linux/rtnetlink.h>
#include <net/if.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

enum { RETRY_MS = 1000 };

/* --- one socket --- */

/* IP_FREEBIND (ip(7)) allows to bind a missing address: the socket works once the address is there. */
static bool bind_early(const struct udp_sockets *sockets, int fd, bool *early)
{
    static const int on = 1;
    const struct sockaddr *local = (const struct sockaddr *)&sockets->local;
    if (bind(fd, local, sizeof sockets->local) == 0)
        return true;
    *early = errno == EADDRNOTAVAIL;
    return *early && setsockopt(fd, IPPROTO_IP, IP_FREEBIND, &on, sizeof on) == 0 &&
           bind(fd, local, sizeof sockets->local) == 0;
}

/* The descriptor, or -1 with errno. */
static int make(const struct udp_sockets *sockets, bool *early)
{
    const char *interface = sockets->interface;
    int fd = socket(AF_INET, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (fd < 0)
        return -1;
    if ((!*interface || setsockopt(fd, SOL_SOCKET, SO_BINDTODEVICE, interface, (socklen_t)strlen(interface)) == 0) &&
        sockets->prepare(fd, sockets->context) && bind_early(sockets, fd, early))
        return fd;
    int error = errno;
    close(fd);
    errno = error;
    return -1;
}

/* A placeholder for a socket that cannot be made yet: nothing arrives, and sending to an IPv4 address fails. */
static int make_idle(void)
{
    return socket(AF_UNIX, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
}

/* --- all of a block --- */

static void say_why(const struct udp_sockets *sockets, int error, char *text, size_t size)
{
    unsigned port = ntohs(sockets->local.sin_port);
    if (error == EADDRINUSE)
        snprintf(text, size, "UDP port %u is taken: another block or program receives there", port);
    else if (error == EACCES)
        snprintf(text, size, "UDP port %u needs CAP_NET_BIND_SERVICE; take one from 1024 on", port);
    else
        snprintf(text, size, "UDP port %u%s%s: %s", port, *sockets->interface ? " of interface " : "",
                 sockets->interface, strerror(error));
}

/* Make a descriptor of the block refer to another socket, atomically for the step that uses it. `fd` is closed. 0 or an
 * errno. */
static int put(const struct udp_sockets *sockets, size_t i, int fd)
{
    int error = fd < 0 || dup3(fd, sockets->fd[i], O_CLOEXEC) < 0 ? errno : 0;
    if (fd >= 0)
        close(fd);
    return error;
}

/* Make the sockets again. The old one is closed first, because it may have the port. 0 or an errno. */
static int replace_all(const struct udp_sockets *sockets)
{
    bool early = false;
    for (size_t i = 0; i < sockets->count; i++) {
        int error = put(sockets, i, make_idle());
        if (!error)
            error = put(sockets, i, make(sockets, &early));
        if (error)
            return error;
    }
    char address[INET_ADDRSTRLEN];
    if (early)
        fl_warn(sockets->block, "%s is not an address of this computer yet: waiting for it",
                inet_ntop(AF_INET, &sockets->local.sin_addr, address, sizeof address));
    return 0;
}

/* The interface may be a new one of the same name: a socket is bound to the index. */
static void follow(struct udp_sockets *sockets)
{
    char text[128];
    unsigned index = if_nametoindex(sockets->interface);
    if (!index)
        sockets->error = 0;
    if (index == sockets->index)
        return;
    int error = index ? replace_all(sockets) : 0;
    if (error) { /* tried again */
        say_why(sockets, error, text, sizeof text);
        if (error != sockets->error)
            fl_warn(sockets->block, "%s", text);
        sockets->error = error;
        return;
    }
    if (index)
        fl_log(sockets->block, "network interface %s is there", sockets->interface);
    else
        fl_warn(sockets->block, "network interface %s is gone: waiting for it", sockets->interface);
    sockets->error = 0;
    sockets->index = index;
}

/* Discard the messages of the kernel: it is enough to know that something changed. */
static void run(struct fl_driver *driver, void *context)
{
    struct udp_sockets *sockets = context;
    char bytes[4096];
    do {
        while (recv(sockets->changes_fd, bytes, sizeof bytes, MSG_DONTWAIT) > 0 || errno == ENOBUFS)
            ;
        follow(sockets);
    } while (fl_driver_wait(driver, sockets->changes_fd, false, sockets->error ? RETRY_MS : -1) != -1);
}

static int watch_interfaces(struct udp_sockets *sockets)
{
    const struct sockaddr_nl link = {.nl_family = AF_NETLINK, .nl_groups = RTMGRP_LINK};
    int fd = socket(AF_NETLINK, SOCK_RAW | SOCK_CLOEXEC, NETLINK_ROUTE);
    if (fd < 0)
        return fl_fail(sockets->block, "cannot watch network interfaces: %s", strerror(errno));
    sockets->changes_fd = fd;
    if (bind(fd, (const struct sockaddr *)&link, sizeof link) == 0)
        sockets->driver = fl_driver_start_ordinary(sockets->block, run, sockets);
    else
        fl_fail(sockets->block, "cannot watch network interfaces: %s", strerror(errno));
    if (sockets->driver)
        return FL_OK;
    close(fd);
    return FL_FAILED;
}

int udp_sockets_open(struct udp_sockets *sockets, struct fl_block *block, size_t count, struct in_addr local_address,
                     int64_t port, const char *interface)
{
    char text[128];
    sockets->block = block;
    sockets->interface = interface;
    sockets->local =
        (struct sockaddr_in){.sin_family = AF_INET, .sin_port = htons((uint16_t)port), .sin_addr = local_address};
    if (strlen(interface) >= IFNAMSIZ)
        return fl_fail(block, "interface: %s is longer than the %d characters of a name", interface, IFNAMSIZ - 1);
    for (sockets->count = 0; sockets->count < count; sockets->count++)
        if ((sockets->fd[sockets->count] = make_idle()) < 0)
            return fl_fail(block, "cannot open a socket: %s", strerror(errno));
    sockets->index = *interface ? if_nametoindex(interface) : 0;
    int error = !*interface || sockets->index ? replace_all(sockets) : 0;
    if (error) {
        say_why(sockets, error, text, sizeof text);
        return fl_fail(block, "%s", text);
    }
    if (!*interface)
        return FL_OK;
    if (!sockets->index)
        fl_warn(block, "there is no network interface %s yet: waiting for it", interface);
    return watch_interfaces(sockets);
}

void udp_sockets_close(struct udp_sockets *sockets)
{
    if (sockets->driver) {
        fl_driver_stop(sockets->driver);
        close(sockets->changes_fd);
        sockets->driver = NULL;
    }
    while (sockets->count)
        close(sockets->fd[--sockets->count]);
}
