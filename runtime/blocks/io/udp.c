#define _GNU_SOURCE
#include "udp.h"

#include <arpa/inet.h>
#include <errno.h>
#include <inttypes.h>
#include <linux/time_types.h>
#include <net/if.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

int udp_read_address(struct fl_block *block, const char *parameter, const char *text, struct in_addr *address)
{
    if (inet_pton(AF_INET, text, address) != 1)
        return fl_fail(block, "parameter %s: %s is not an IPv4 address such as 192.168.1.3", parameter, text);
    if (IN_MULTICAST(ntohl(address->s_addr)))
        return fl_fail(block, "parameter %s: %s is a multicast group; give one computer's address or a broadcast's",
                       parameter, text);
    return FL_OK;
}

int udp_read_addresses(struct fl_block *block, const char *parameter, struct fl_texts texts, struct in_addr *addresses)
{
    if (texts.count < 1 || texts.count > FL_SENDERS)
        return fl_fail(block, "parameter %s: give 1 to %d addresses", parameter, FL_SENDERS);
    for (size_t i = 0; i < texts.count; i++) {
        if (udp_read_address(block, parameter, texts.value[i], &addresses[i]) != FL_OK)
            return FL_FAILED;
        if (addresses[i].s_addr == INADDR_ANY && texts.count > 1)
            return fl_fail(block, "parameter %s: 0.0.0.0 is anybody, and cannot be one of several", parameter);
    }
    return FL_OK;
}

static int fail_to_bind(struct fl_block *block, const char *local_address, int64_t port)
{
    if (errno == EADDRINUSE)
        return fl_fail(block, "UDP port %" PRId64 " is taken: another block or program receives there", port);
    if (errno == EADDRNOTAVAIL)
        return fl_fail(block, "%s is no address of this computer", local_address);
    if (errno == EACCES)
        return fl_fail(block, "UDP port %" PRId64 " needs CAP_NET_BIND_SERVICE; take one from 1024 on", port);
    return fl_fail(block, "cannot bind UDP port %" PRId64 ": %s", port, strerror(errno));
}

int udp_open(struct fl_block *block, const char *local_address, int64_t port, const char *interface)
{
    struct sockaddr_in local = {.sin_family = AF_INET, .sin_port = htons((uint16_t)port)};
    if (udp_read_address(block, "local_address", local_address, &local.sin_addr) != FL_OK)
        return -1;
    if (strlen(interface) >= IFNAMSIZ || (*interface && !if_nametoindex(interface))) {
        fl_fail(block, "there is no network interface %s", interface);
        return -1;
    }
    int fd = socket(AF_INET, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (fd < 0) {
        fl_fail(block, "cannot open a UDP socket: %s", strerror(errno));
        return -1;
    }
    if (*interface && setsockopt(fd, SOL_SOCKET, SO_BINDTODEVICE, interface, (socklen_t)strlen(interface)) < 0)
        fl_fail(block, "cannot bind to network interface %s: %s", interface, strerror(errno));
    else if (bind(fd, (struct sockaddr *)&local, sizeof local) < 0)
        fail_to_bind(block, local_address, port);
    else
        return fd;
    close(fd);
    return -1;
}

int udp_receiver_check(struct fl_block *block, const char *local_address, struct fl_texts from)
{
    struct in_addr addresses[FL_SENDERS];
    if (udp_read_address(block, "local_address", local_address, &addresses[0]) != FL_OK)
        return FL_FAILED;
    return udp_read_addresses(block, "from", from, addresses);
}

int udp_receiver_open(struct udp_receiver *receiver, struct fl_block *block, const char *local_address, int64_t port,
                      const char *interface, struct fl_texts from, double failover)
{
    static const int on = 1;
    *receiver =
        (struct udp_receiver){.emptied_ns = fl_now_ns(), .from_count = from.count, .failover_timeout = failover};
    fl_failover_begin(&receiver->failover, receiver->emptied_ns);
    if (udp_read_addresses(block, "from", from, receiver->from) != FL_OK)
        return FL_FAILED;
    receiver->fd = udp_open(block, local_address, port, interface);
    if (receiver->fd < 0)
        return FL_FAILED;
    receiver->open = true;
    /* The new time stamp has 64 bits on i386 too. */
    if (setsockopt(receiver->fd, SOL_SOCKET, SO_TIMESTAMPNS_NEW, &on, sizeof on) < 0 ||
        setsockopt(receiver->fd, SOL_SOCKET, SO_RXQ_OVFL, &on, sizeof on) < 0)
        return fl_fail(block, "the kernel cannot stamp datagrams: %s", strerror(errno));
    return FL_OK;
}

int64_t udp_arrival_ns(int64_t stamp_ns, int64_t wall_ns, int64_t now_ns, int64_t emptied_ns)
{
    int64_t arrived_ns = now_ns - (wall_ns - stamp_ns);
    if (arrived_ns > now_ns)
        return now_ns;
    return arrived_ns < emptied_ns ? emptied_ns : arrived_ns;
}

static int64_t wall_ns(void)
{
    struct timespec wall;
    clock_gettime(CLOCK_REALTIME, &wall);
    return wall.tv_sec * INT64_C(1000000000) + wall.tv_nsec;
}

static int64_t read_control(struct udp_receiver *receiver, struct msghdr *message)
{
    int64_t stamp_ns = INT64_MAX; /* as if just now */
    for (struct cmsghdr *control = CMSG_FIRSTHDR(message); control; control = CMSG_NXTHDR(message, control)) {
        if (control->cmsg_level != SOL_SOCKET)
            continue;
        if (control->cmsg_type == SO_TIMESTAMPNS_NEW) {
            struct __kernel_timespec stamp;
            memcpy(&stamp, CMSG_DATA(control), sizeof stamp);
            stamp_ns = stamp.tv_sec * INT64_C(1000000000) + stamp.tv_nsec;
        } else if (control->cmsg_type == SO_RXQ_OVFL) {
            memcpy(&receiver->dropped, CMSG_DATA(control), sizeof receiver->dropped);
        }
    }
    return stamp_ns;
}

/* The sender's place in `from`, or its length. */
static size_t rank_of(const struct udp_receiver *receiver, const struct sockaddr_in *sender)
{
    size_t rank = 0;
    while (rank < receiver->from_count && receiver->from[rank].s_addr != INADDR_ANY &&
           receiver->from[rank].s_addr != sender->sin_addr.s_addr)
        rank++;
    return rank;
}

bool udp_receive(struct udp_receiver *receiver, void *bytes, size_t length, int64_t *arrived_ns, int *budget)
{
    while ((*budget)-- > 0) {
        _Alignas(struct cmsghdr) char control[CMSG_SPACE(sizeof(struct __kernel_timespec)) + CMSG_SPACE(4)];
        struct sockaddr_in sender = {0};
        struct iovec part = {bytes, length};
        struct msghdr message = {.msg_name = &sender,
                                 .msg_namelen = sizeof sender,
                                 .msg_iov = &part,
                                 .msg_iovlen = 1,
                                 .msg_control = control,
                                 .msg_controllen = sizeof control};
        int64_t before_ns = fl_now_ns();
        ssize_t got = recvmsg(receiver->fd, &message, MSG_DONTWAIT | MSG_TRUNC);
        if (got < 0 && errno == EAGAIN)
            receiver->emptied_ns = before_ns;
        if (got < 0) {
            *budget = 0;
            return false;
        }
        int64_t stamp_ns = read_control(receiver, &message);
        size_t rank = rank_of(receiver, &sender);
        if ((size_t)got != length || rank == receiver->from_count) {
            receiver->refused++;
            continue;
        }
        /* In this order: what delays between the two lets the datagram look older, never younger. */
        int64_t now_ns = fl_now_ns();
        int64_t came_ns = udp_arrival_ns(stamp_ns, wall_ns(), now_ns, receiver->emptied_ns);
        if (fl_failover_takes(&receiver->failover, rank, came_ns, receiver->failover_timeout)) {
            receiver->sender = (uint32_t)rank;
            *arrived_ns = came_ns;
            return true;
        }
    }
    *budget = 0;
    return false;
}

void udp_receiver_outputs(const struct udp_receiver *receiver, struct fl_block *block, uint32_t first)
{
    FL_OUT(block, first, uint32_t) = receiver->dropped;
    FL_OUT(block, first + 1, uint32_t) = receiver->refused;
    FL_OUT(block, first + 2, uint32_t) = receiver->sender;
}

void udp_receiver_close(struct udp_receiver *receiver)
{
    if (receiver->open)
        close(receiver->fd);
    receiver->open = false;
}
