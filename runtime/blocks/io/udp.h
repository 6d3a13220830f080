/* UDP over IPv4 for blocks: what their parameters say, and receiving, which never waits. */
#ifndef FLOTILLA_IO_UDP_H
#define FLOTILLA_IO_UDP_H

#include "udp_sockets.h"

enum {
    /* What fits one Ethernet or 802.11 frame: a datagram in fragments is lost with any of them. */
    UDP_LONGEST = 1500 - 20 - 8,
    /* Datagrams that one step takes at most: a flood must not delay it. */
    UDP_BURST = 64,
};

/* Where a socket of this computer is: members and parameters of a block. */
#define UDP_LOCAL_MEMBERS                                                                                              \
    const char *local_address;                                                                                         \
    const char *interface

#define UDP_LOCAL_PARAMETERS(type)                                                                                     \
    FL_PARAMETER(type, local_address, .fallback = "0.0.0.0",                                                           \
                 .summary = "IPv4 address of this computer, which may come later; 0.0.0.0: any"),                      \
        FL_PARAMETER(type, interface, .fallback = "",                                                                  \
                     .summary = "network interface that datagrams have to pass, such as wlan0, which may come later; " \
                                "empty: any")

/* What a block that receives has besides. */
#define UDP_RECEIVER_MEMBERS                                                                                           \
    int64_t port;                                                                                                      \
    UDP_LOCAL_MEMBERS;                                                                                                 \
    struct fl_texts from;                                                                                              \
    double failover

#define UDP_RECEIVER_PARAMETERS(type)                                                                                  \
    FL_PARAMETER(type, port, .min = 1, .max = 65535, .summary = "UDP port of this computer"),                          \
        UDP_LOCAL_PARAMETERS(type),                                                                                    \
        FL_PARAMETER(type, from, .fallback = "0.0.0.0",                                                                \
                     .summary = "IPv4 address that is listened to alone, or several, the first in rank first; "        \
                                "0.0.0.0: all are"),                                                                   \
        FL_FAILOVER(type)

/* Read a parameter's IPv4 address, of one computer or of a broadcast, for `configure`. FL_OK or FL_FAILED. */
int udp_read_address(struct fl_block *block, const char *parameter, const char *text, struct in_addr *address);

/* The same for a list of 1 to FL_SENDERS addresses, in which 0.0.0.0 stands alone. */
int udp_read_addresses(struct fl_block *block, const char *parameter, struct fl_texts texts, struct in_addr *addresses);

/* --- receiving --- */

struct udp_receiver {
    struct udp_sockets sockets; /* one */
    struct in_addr from[FL_SENDERS];
    size_t from_count;
    size_t length;   /* bytes of a datagram */
    uint32_t sender; /* of the datagram that was taken last: its place in `from` */
    struct fl_failover failover;
    double failover_timeout;
    int64_t emptied_ns; /* when last nothing waited: what comes later has arrived later */
    uint32_t lost;      /* by the kernel's count, whatever the reason */
    uint32_t dropped;   /* of these, for want of room */
    uint32_t refused;   /* of these, of another length, or from none of `from` */
};

#define UDP_RECEIVER_OUTPUTS                                                                                           \
    {.name = "dropped", .type = FL_UINT32, .width = 1, .summary = "datagrams lost while the queue was full"},          \
        {.name = "refused", .type = FL_UINT32, .width = 1, .summary = "datagrams of another length or sender"},        \
        {.name = "sender", .type = FL_UINT32, .width = 1, .summary = "who is listened to: 0 is the first of `from`"}

/* Whether the addresses among the parameters can be read, for `configure`. */
int udp_receiver_check(struct fl_block *block, const char *local_address, struct fl_texts from);

int udp_receiver_open(struct udp_receiver *receiver, struct fl_block *block, const char *local_address, int64_t port,
                      const char *interface, struct fl_texts from, double failover, size_t length);

/* Write the outputs UDP_RECEIVER_OUTPUTS, of which `dropped` is number `first`. */
void udp_receiver_outputs(const struct udp_receiver *receiver, struct fl_block *block, uint32_t first);

/* When a datagram arrived, on CLOCK_MONOTONIC. The kernel stamps by the wall clock, which may be set at any time: what
 * comes out of that wrong is kept between what is known for sure, after the queue was last empty and before now. */
int64_t udp_arrival_ns(int64_t stamp_ns, int64_t wall_ns, int64_t now_ns, int64_t emptied_ns);

/* Take the next datagram, which has the receiver's length and one of its senders. Each call takes one off `budget`,
 * UDP_BURST at the begin of a step, and there is none for a budget of 0. `arrived_ns` is when the kernel got it
 * (SO_TIMESTAMPNS, see socket(7)), on CLOCK_MONOTONIC; in the first moments after the first socket of a computer asked
 * for stamps, when it was read. */
bool udp_receive(struct udp_receiver *receiver, void *bytes, int64_t *arrived_ns, int *budget);

void udp_receiver_close(struct udp_receiver *receiver);

#endif
