/* CAN on a computer without: sockets of the family AF_CAN become UDP sockets to a hub on 127.0.0.1, whose port is in
 * $CAN_HUB; a datagram is a struct can_frame, and an empty one makes a socket known. Filters, reports and time stamps
 * behave as the kernel's, as far as the runtime uses them. The interface can0 is there and up; where $CAN_LINK names a
 * file, it is as the file says: its index and `up`, `down` or `no-carrier`, and missing where the file is. Included by
 * tests, and a shared object for LD_PRELOAD, so that the code under test is what robots run. */
#ifndef _GNU_SOURCE
#define _GNU_SOURCE
#endif
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <netinet/in.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/un.h>
#include <unistd.h>

enum { UDP_CAN_SOCKETS = 64, UDP_CAN_FILTERS = 16, UDP_CAN_INDEX = 7 };

/* By descriptor. A new socket receives all frames and no reports, as the kernel's. */
static struct udp_can {
    bool is_can;
    struct can_filter filters[UDP_CAN_FILTERS];
    size_t filter_count;
    can_err_mask_t reports;
    unsigned index; /* of the interface that it is bound to */
    bool reported;  /* that the interface is gone, or down: the kernel says it once */
} udp_cans[UDP_CAN_SOCKETS];

static void *udp_can_real(const char *name)
{
    void *real = dlsym(RTLD_NEXT, name);
    if (!real)
        abort();
    return real;
}

static struct udp_can *udp_can_of(int fd)
{
    return fd >= 0 && fd < UDP_CAN_SOCKETS && udp_cans[fd].is_can ? &udp_cans[fd] : NULL;
}

struct udp_can_link {
    unsigned index; /* 0: there is none */
    short flags;
};

static struct udp_can_link udp_can_link(void)
{
    const char *path = getenv("CAN_LINK");
    char text[32] = "";
    if (!path)
        return (struct udp_can_link){UDP_CAN_INDEX, IFF_UP | IFF_RUNNING};
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0)
        return (struct udp_can_link){0, 0};
    ssize_t count = read(fd, text, sizeof text - 1);
    close(fd);
    if (count <= 0)
        return (struct udp_can_link){0, 0};
    return (struct udp_can_link){(unsigned)atoi(text), strstr(text, "up")           ? IFF_UP | IFF_RUNNING
                                                       : strstr(text, "no-carrier") ? IFF_UP
                                                                                    : 0};
}

/* 0, or what the kernel says to a socket on an interface that is gone or down. */
static int udp_can_error(const struct udp_can *can, int gone)
{
    struct udp_can_link link = udp_can_link();
    return !can->index || can->index != link.index ? gone : link.flags & IFF_UP ? 0 : ENETDOWN;
}

unsigned if_nametoindex(const char *name)
{
    unsigned index = getenv("CAN_HUB") && strcmp(name, "can0") == 0 ? udp_can_link().index : 0;
    if (!index)
        errno = ENODEV;
    return index;
}

int ioctl(int fd, unsigned long request, ...)
{
    va_list arguments;
    va_start(arguments, request);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    if (!udp_can_of(fd) || request != SIOCGIFFLAGS)
        return (int)syscall(SYS_ioctl, fd, request, argument);
    struct udp_can_link link = udp_can_link();
    ((struct ifreq *)argument)->ifr_flags = link.flags;
    if (!link.index)
        errno = ENODEV;
    return link.index ? 0 : -1;
}

int socket(int domain, int type, int protocol)
{
    bool is_can = domain == AF_CAN && getenv("CAN_HUB");
    int fd = (int)(is_can ? syscall(SYS_socket, AF_INET, SOCK_DGRAM | (type & (SOCK_NONBLOCK | SOCK_CLOEXEC)), 0)
                          : syscall(SYS_socket, domain, type, protocol));
    if (fd >= 0 && fd < UDP_CAN_SOCKETS)
        udp_cans[fd] = (struct udp_can){.is_can = is_can, .filters = {{0, 0}}, .filter_count = 1};
    else if (is_can)
        abort();
    return fd;
}

int setsockopt(int fd, int level, int option, const void *value, socklen_t size)
{
    struct udp_can *can = udp_can_of(fd);
    if (can && level == SOL_CAN_RAW && option == CAN_RAW_FILTER && size <= sizeof can->filters) {
        if (size)
            memcpy(can->filters, value, size);
        can->filter_count = size / sizeof can->filters[0];
        return 0;
    }
    if (can && level == SOL_CAN_RAW && option == CAN_RAW_ERR_FILTER && size == sizeof can->reports) {
        memcpy(&can->reports, value, size);
        return 0;
    }
    return ((int (*)(int, int, int, const void *, socklen_t))(uintptr_t)udp_can_real("setsockopt"))(fd, level, option,
                                                                                                    value, size);
}

/* An abstract Unix address says which bus it is about: others may run beside this one. */
static int udp_can_named(const char *call, int fd, const struct sockaddr *address, socklen_t size)
{
    const char *hub = getenv("CAN_HUB");
    struct sockaddr_un named;
    if (hub && address->sa_family == AF_UNIX && size + strlen(hub) <= sizeof named) {
        memcpy(&named, address, size);
        if (!named.sun_path[0]) {
            memcpy((char *)&named + size, hub, strlen(hub));
            address = (const struct sockaddr *)&named;
            size += (socklen_t)strlen(hub);
        }
    }
    return ((int (*)(int, const struct sockaddr *, socklen_t))(uintptr_t)udp_can_real(call))(fd, address, size);
}

int connect(int fd, const struct sockaddr *address, socklen_t size)
{
    return udp_can_named("connect", fd, address, size);
}

int bind(int fd, const struct sockaddr *address, socklen_t size)
{
    struct udp_can *can = udp_can_of(fd);
    if (!can)
        return udp_can_named("bind", fd, address, size);
    const struct sockaddr_can *asked = (const struct sockaddr_can *)(const void *)address;
    struct sockaddr_in hub = {.sin_family = AF_INET,
                              .sin_port = htons((uint16_t)atoi(getenv("CAN_HUB"))),
                              .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    if ((unsigned)asked->can_ifindex != udp_can_link().index) {
        errno = ENODEV;
        return -1;
    }
    can->index = (unsigned)asked->can_ifindex;
    if (connect(fd, (struct sockaddr *)&hub, sizeof hub) < 0 || syscall(SYS_sendto, fd, "", 0, 0, NULL, 0) < 0)
        return -1;
    return 0;
}

static bool udp_can_passes(const struct udp_can *can, const struct can_frame *frame)
{
    if (frame->can_id & CAN_ERR_FLAG)
        return frame->can_id & can->reports;
    for (size_t i = 0; i < can->filter_count; i++)
        if ((frame->can_id & can->filters[i].can_mask) == (can->filters[i].can_id & can->filters[i].can_mask))
            return true;
    return false;
}

ssize_t recvmsg(int fd, struct msghdr *message, int flags)
{
    struct udp_can *can = udp_can_of(fd);
    size_t room = message->msg_controllen;
    for (;;) {
        int error = can ? udp_can_error(can, ENODEV) : 0;
        message->msg_controllen = room;
        ssize_t count =
            ((ssize_t (*)(int, struct msghdr *, int))(uintptr_t)udp_can_real("recvmsg"))(fd, message, flags);
        if (error && count < 0 && !can->reported) {
            can->reported = true;
            errno = error;
            return -1;
        }
        if (can && !error)
            can->reported = false;
        if (!can || count < 0 || (!error && udp_can_passes(can, message->msg_iov[0].iov_base)))
            return count;
    }
}

ssize_t send(int fd, const void *data, size_t size, int flags)
{
    const struct udp_can *can = udp_can_of(fd);
    int error = can ? udp_can_error(can, ENXIO) : 0;
    if (!error)
        return syscall(SYS_sendto, fd, data, size, flags, NULL, 0);
    errno = error;
    return -1;
}
