#define _GNU_SOURCE
#include "udp.h"

#include "wall_clock.h"

#include <arpa/inet.h>
#include <errno.h>
#include <linux/filter.h>
#include <linux/sock_diag.h>
#include <linux/time_types.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/uio.h>
#include <time.h>

int udp_read_address(struct fl_block *block, const char *parameter, const char *text, struct in_addr *address)
{
    if (inet_pton(AF_INET, text, address) != 1)
        return fl_fail(block, "parameter %s: %s is not an IPv4 address such as 192.168.1.3", parameter, text);
    if (IN_MULTICAST(ntohl(address->s_addr)))
        return fl_fail(block, "parameter %s: %s is a multicast group; give one computer's address or a broadcast's",
                       parameter, text);
    return FL_OK;
}

int udp_read_addresses(struct fl_block *block, const char *parameter, struct fl_strings strings,
                       struct in_addr *addresses)
{
    if (strings.count < 1 || strings.count > FL_SENDERS)
        return fl_fail(block, "parameter %s: give 1 to %d addresses", parameter, FL_SENDERS);
    for (size_t i = 0; i < strings.count; i++) {
        if (udp_read_address(block, parameter, strings.value[i], &addresses[i]) != FL_OK)
            return FL_FAILED;
        if (addresses[i].s_addr == INADDR_ANY && strings.count > 1)
            return fl_fail(block, "parameter %s: 0.0.0.0 is anybody, and cannot be one of several", parameter);
    }
    return FL_OK;
}

int udp_check_keys(struct fl_block *block, const char *parameter, const char *keys, int64_t length,
                   struct fl_strings addresses)
{
    if (!*keys)
        return FL_OK;
    if (length > UDP_LONGEST - AUTHENTICATION_TRAILER)
        return fl_fail(block, "parameter length: with keys a payload has at most %d bytes",
                       UDP_LONGEST - AUTHENTICATION_TRAILER);
    for (size_t i = 0; i < addresses.count; i++) {
        struct in_addr address;
        if (udp_read_address(block, parameter, addresses.value[i], &address) != FL_OK)
            return FL_FAILED;
        if (address.s_addr == INADDR_ANY || address.s_addr == INADDR_BROADCAST)
            return fl_fail(block,
                           "parameter keys: %s is many computers, and each has a key of its own; name them by %s",
                           addresses.value[i], parameter);
    }
    return FL_OK;
}

/* The datagrams that a receiver accepts: of its length, from one of its senders. The kernel applies the filter before a
 * datagram joins the queue, so others take neither its room nor the time of a step. The packet begins with the UDP
 * header (linux/Documentation/networking/filter.rst). */
struct filter {
    struct sock_filter code[FL_SENDERS + 5];
    unsigned short count;
};

static struct filter filter_of(const struct in_addr *from, size_t count, size_t length)
{
    enum { UDP_HEADER = 8, IP_SOURCE = 12 };
    struct filter filter = {.count = 0};
    bool anybody = from[0].s_addr == INADDR_ANY;
    if (!anybody) {
        filter.code[filter.count++] =
            (struct sock_filter)BPF_STMT(BPF_LD | BPF_W | BPF_ABS, (unsigned)SKF_NET_OFF + IP_SOURCE);
        /* Jump to the check of the length, past the remaining senders and the refusal. */
        for (size_t i = 0; i < count; i++)
            filter.code[filter.count++] = (struct sock_filter)BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, ntohl(from[i].s_addr),
                                                                       (unsigned char)(count - i), 0);
        filter.code[filter.count++] = (struct sock_filter)BPF_STMT(BPF_RET | BPF_K, 0);
    }
    filter.code[filter.count++] = (struct sock_filter)BPF_STMT(BPF_LD | BPF_W | BPF_LEN, 0);
    filter.code[filter.count++] =
        (struct sock_filter)BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, (unsigned)length + UDP_HEADER, 0, 1);
    filter.code[filter.count++] = (struct sock_filter)BPF_STMT(BPF_RET | BPF_K, UINT32_MAX);
    filter.code[filter.count++] = (struct sock_filter)BPF_STMT(BPF_RET | BPF_K, 0);
    return filter;
}

/* Bytes behind a payload. */
static size_t trailer_of(const struct udp_receiver *receiver)
{
    return receiver->authenticated ? AUTHENTICATION_TRAILER : 0;
}

static bool prepare(int fd, const void *context)
{
    static const int on = 1;
    const struct udp_receiver *receiver = context;
    struct filter filter = filter_of(receiver->from, receiver->from_count, receiver->length + trailer_of(receiver));
    const struct sock_fprog program = {filter.count, filter.code};
    /* The new time stamp has 64 bits on i386 too. */
    return setsockopt(fd, SOL_SOCKET, SO_ATTACH_FILTER, &program, sizeof program) == 0 &&
           setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS_NEW, &on, sizeof on) == 0 && socket_bound_queue(fd);
}

int udp_receiver_check(struct fl_block *block, const char *local_address, struct fl_strings from)
{
    struct in_addr addresses[FL_SENDERS];
    if (udp_read_address(block, "local_address", local_address, &addresses[0]) != FL_OK)
        return FL_FAILED;
    return udp_read_addresses(block, "from", from, addresses);
}

static int read_keys(struct udp_receiver *receiver, struct fl_block *block, const char *keys, int64_t port)
{
    uint8_t key[AUTHENTICATION_KEY];
    for (size_t i = 0; i < receiver->from_count; i++) {
        if (authentication_read_key(block, keys, receiver->from[i], AUTHENTICATION_FROM, key) != FL_OK)
            return FL_FAILED;
        authentication_receiver_begin(&receiver->authentication[i], key, (uint16_t)port);
    }
    explicit_bzero(key, sizeof key);
    return FL_OK;
}

int udp_receiver_open(struct udp_receiver *receiver, struct fl_block *block, const char *local_address, int64_t port,
                      const char *interface, struct fl_strings from, double failover, size_t length, const char *keys)
{
    struct in_addr local;
    *receiver = (struct udp_receiver){.sockets = {.prepare = prepare, .context = receiver},
                                      .emptied_ns = fl_now_ns(),
                                      .from_count = from.count,
                                      .failover_timeout = failover,
                                      .length = length,
                                      .authenticated = *keys != 0};
    fl_failover_begin(&receiver->failover, receiver->emptied_ns);
    if (udp_read_addresses(block, "from", from, receiver->from) != FL_OK ||
        udp_read_address(block, "local_address", local_address, &local) != FL_OK ||
        (*keys && read_keys(receiver, block, keys, port) != FL_OK))
        return FL_FAILED;
    return udp_sockets_open(&receiver->sockets, block, 1, local, port, interface);
}

int64_t udp_arrival_ns(int64_t stamp_ns, int64_t wall_ns, int64_t now_ns, int64_t emptied_ns)
{
    int64_t arrived_ns = now_ns - (wall_ns - stamp_ns);
    if (arrived_ns > now_ns)
        return now_ns;
    return arrived_ns < emptied_ns ? emptied_ns : arrived_ns;
}

static int64_t read_stamp(struct msghdr *message)
{
    for (struct cmsghdr *control = CMSG_FIRSTHDR(message); control; control = CMSG_NXTHDR(message, control)) {
        if (control->cmsg_level == SOL_SOCKET && control->cmsg_type == SO_TIMESTAMPNS_NEW) {
            struct __kernel_timespec stamp;
            memcpy(&stamp, CMSG_DATA(control), sizeof stamp);
            return stamp.tv_sec * INT64_C(1000000000) + stamp.tv_nsec;
        }
    }
    return INT64_MAX; /* as if just now */
}

/* The kernel has one counter for refused datagrams and for those that found the queue full. The queue is full only
 * until it is read, so its state before reading tells which of the two it was. */
static void count_lost(struct udp_receiver *receiver)
{
    enum { DATAGRAM = 4096 }; /* memory that the kernel charges for one, at most */
    uint32_t now[SK_MEMINFO_VARS] = {0};
    socklen_t size = sizeof now;
    if (getsockopt(receiver->sockets.fd[0], SOL_SOCKET, SO_MEMINFO, now, &size) < 0)
        return;
    if (now[SK_MEMINFO_DROPS] < receiver->lost)
        receiver->lost = 0; /* a new socket */
    bool full = now[SK_MEMINFO_RMEM_ALLOC] + DATAGRAM > now[SK_MEMINFO_RCVBUF];
    *(full ? &receiver->dropped : &receiver->refused) += now[SK_MEMINFO_DROPS] - receiver->lost;
    receiver->lost = now[SK_MEMINFO_DROPS];
}

/* The sender's place in `from`: the filter lets no other one pass. */
static size_t rank_of(const struct udp_receiver *receiver, const struct sockaddr_in *sender)
{
    size_t rank = 0;
    while (rank + 1 < receiver->from_count && receiver->from[rank].s_addr != sender->sin_addr.s_addr)
        rank++;
    return rank;
}

/* Whether a datagram is from who it says, and new. Who cannot know yet what proves that is told. */
static bool authentic(struct udp_receiver *receiver, size_t rank, const struct sockaddr_in *sender, const void *bytes,
                      const uint8_t trailer[AUTHENTICATION_TRAILER])
{
    uint8_t challenge[AUTHENTICATION_CHALLENGE];
    if (!receiver->authenticated)
        return true;
    switch (authentication_judge(&receiver->authentication[rank], bytes, receiver->length, trailer, challenge)) {
    case AUTHENTICATION_GOOD:
        return true;
    case AUTHENTICATION_FORGED:
        receiver->forged++;
        return false;
    case AUTHENTICATION_UNANSWERED: /* if it gets lost, the next message asks for another */
        sendto(receiver->sockets.fd[0], challenge, sizeof challenge, MSG_DONTWAIT, (const struct sockaddr *)sender,
               sizeof *sender);
        break;
    case AUTHENTICATION_REPLAYED:
        break;
    }
    receiver->replayed++;
    return false;
}

struct udp_budget udp_budget_of(const struct fl_block *block)
{
    return (struct udp_budget){SOCKET_BURST, fl_now_ns() + block->period_ns / UDP_REFUSING};
}

bool udp_receive(struct udp_receiver *receiver, void *bytes, int64_t *arrived_ns, struct udp_budget *budget)
{
    int64_t now_ns = 0;
    if (budget->datagrams == SOCKET_BURST)
        count_lost(receiver);
    while (budget->datagrams-- > 0 && now_ns < budget->until_ns) {
        _Alignas(struct cmsghdr) char control[CMSG_SPACE(sizeof(struct __kernel_timespec))];
        struct sockaddr_in sender = {0};
        uint8_t trailer[AUTHENTICATION_TRAILER];
        struct iovec parts[] = {{bytes, receiver->length}, {trailer, trailer_of(receiver)}};
        struct msghdr message = {.msg_name = &sender,
                                 .msg_namelen = sizeof sender,
                                 .msg_iov = parts,
                                 .msg_iovlen = 2,
                                 .msg_control = control,
                                 .msg_controllen = sizeof control};
        int64_t before_ns = fl_now_ns();
        ssize_t got = recvmsg(receiver->sockets.fd[0], &message, MSG_DONTWAIT);
        if (got < 0 && errno == EAGAIN)
            receiver->emptied_ns = before_ns;
        if (got < 0)
            break;
        size_t rank = rank_of(receiver, &sender);
        bool good = authentic(receiver, rank, &sender, bytes, trailer);
        now_ns = fl_now_ns();
        if (!good)
            continue;
        int64_t stamp_ns = read_stamp(&message), wall_ns = now_ns + fl_wall_less_monotonic_ns();
        int64_t came_ns = udp_arrival_ns(stamp_ns, wall_ns, now_ns, receiver->emptied_ns);
        if (fl_failover_takes(&receiver->failover, rank, came_ns, receiver->failover_timeout)) {
            receiver->sender = (uint32_t)rank;
            *arrived_ns = came_ns;
            return true;
        }
    }
    budget->datagrams = 0;
    return false;
}

void udp_receiver_outputs(const struct udp_receiver *receiver, struct fl_block *block, uint32_t first)
{
    FL_OUT(block, first, uint32_t) = receiver->dropped;
    FL_OUT(block, first + 1, uint32_t) = receiver->refused;
    FL_OUT(block, first + 2, uint32_t) = receiver->sender;
}

void udp_keys_outputs(const struct udp_receiver *receiver, struct fl_block *block, uint32_t first)
{
    FL_OUT(block, first, uint32_t) = receiver->forged;
    FL_OUT(block, first + 1, uint32_t) = receiver->replayed;
}

void udp_receiver_close(struct udp_receiver *receiver)
{
    udp_sockets_close(&receiver->sockets);
}
