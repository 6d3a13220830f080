/* UDP over IPv4 for blocks: parameters, and receiving without waiting. */
#ifndef FLOTILLA_CORE_UDP_H
#define FLOTILLA_CORE_UDP_H

#include "authentication.h"
#include "socket_queue.h"
#include "udp_sockets.h"

enum {
    /* The payload of one Ethernet or 802.11 frame: a fragmented datagram is lost with any of its fragments. */
    UDP_LONGEST = 1500 - 20 - 8,
    /* Of a step's period, one part in so many goes to datagrams that are refused: to find out costs more than to take
     * one, and who floods a fast task chooses what costs most. */
    UDP_REFUSING = 4,
};

/* What one step spends on datagrams. */
struct udp_budget {
    int datagrams;
    int64_t until_ns; /* on CLOCK_MONOTONIC; from then on the next that is refused is the last one looked at */
};

/* At the begin of a step. */
struct udp_budget udp_budget_of(const struct fl_block *block);

/* Local address and interface of a socket: members and parameters of a block. */
#define UDP_LOCAL_MEMBERS                                                                                              \
    const char *local_address;                                                                                         \
    const char *interface

#define UDP_LOCAL_PARAMETERS(type)                                                                                     \
    FL_PARAMETER(type, local_address, .default_value = "0.0.0.0",                                                      \
                 .summary = "IPv4 address of this computer, which may come later; 0.0.0.0: any"),                      \
        FL_PARAMETER(type, interface, .default_value = "",                                                             \
                     .summary = "network interface that datagrams have to pass, such as wlan0, which may come later; " \
                                "empty: any")

/* Key file of a block whose messages are authenticated: member and parameter. */
#define UDP_KEYS_MEMBER const char *keys
#define UDP_KEYS_PARAMETER(type)                                                                                       \
    FL_PARAMETER(type, keys, .default_value = "",                                                                      \
                 .summary = "file with keys shared with other computers, absolute or among the service's "             \
                            "credentials; empty: messages are not authenticated")

/* Further members and parameters of a block that receives. */
#define UDP_RECEIVER_MEMBERS                                                                                           \
    int64_t port;                                                                                                      \
    UDP_LOCAL_MEMBERS;                                                                                                 \
    struct fl_strings from;                                                                                            \
    double failover

#define UDP_RECEIVER_PARAMETERS(type)                                                                                  \
    FL_PARAMETER(type, port, .min = 1, .max = 65535, .summary = "UDP port of this computer"),                          \
        UDP_LOCAL_PARAMETERS(type),                                                                                    \
        FL_PARAMETER(type, from, .default_value = "0.0.0.0",                                                           \
                     .summary = "IPv4 address of the only sender that is listened to, or several by rank; "            \
                                "0.0.0.0: any sender"),                                                                \
        FL_FAILOVER(type)

/* Read a parameter's IPv4 address, of one computer or of a broadcast, for `configure`. FL_OK or FL_FAILED. */
int udp_read_address(struct fl_block *block, const char *parameter, const char *text, struct in_addr *address);

/* The same for a list of 1 to FL_SENDERS addresses, in which 0.0.0.0 stands alone. */
int udp_read_addresses(struct fl_block *block, const char *parameter, struct fl_strings strings,
                       struct in_addr *addresses);

/* For `configure` of a block with `keys`: whether they are possible with these addresses, which are those of a
 * parameter, and with a payload of that length. */
int udp_check_keys(struct fl_block *block, const char *parameter, const char *keys, int64_t length,
                   struct fl_strings addresses);

/* --- receiving --- */

struct udp_receiver {
    struct udp_sockets sockets; /* one */
    struct in_addr from[FL_SENDERS];
    size_t from_count;
    size_t length;   /* bytes of a datagram's payload */
    uint32_t sender; /* sender of the last datagram taken: its place in `from` */
    struct fl_failover failover;
    double failover_timeout;
    int64_t emptied_ns; /* when the queue was last empty: later datagrams arrived after this */
    uint32_t lost;      /* datagrams lost by the count of the kernel, for any reason */
    uint32_t dropped;   /* of these, lost because the queue was full */
    uint32_t refused;   /* of these, refused: of another length, or not from one of `from` */
    bool authenticated;
    struct authentication_receiver authentication[FL_SENDERS];
    uint32_t forged;   /* datagrams without a proof of their sender */
    uint32_t replayed; /* datagrams that were repeated or overtaken, or are not proven to be new yet */
};

#define UDP_RECEIVER_OUTPUTS                                                                                           \
    {.name = "dropped", .type = FL_UINT32, .width = 1, .summary = "datagrams lost while the queue was full"},          \
        {.name = "refused",                                                                                            \
         .type = FL_UINT32,                                                                                            \
         .width = 1,                                                                                                   \
         .flags = FL_REFUSALS,                                                                                         \
         .summary = "datagrams of another length or sender"},                                                          \
        {.name = "sender",                                                                                             \
         .type = FL_UINT32,                                                                                            \
         .width = 1,                                                                                                   \
         .summary = "rank of the sender that is listened to: 0 is the first of `from`"}

/* Further outputs of a block with `keys`. */
#define UDP_KEYS_OUTPUTS                                                                                               \
    {.name = "forged",                                                                                                 \
     .type = FL_UINT32,                                                                                                \
     .width = 1,                                                                                                       \
     .flags = FL_REFUSALS,                                                                                             \
     .summary = "datagrams that no key of `keys` proves"},                                                             \
        {.name = "replayed",                                                                                           \
         .type = FL_UINT32,                                                                                            \
         .width = 1,                                                                                                   \
         .flags = FL_REFUSALS,                                                                                         \
         .summary = "datagrams that came again or late, or came before their sender proved them new"}

/* For `configure`: check the addresses among the parameters. */
int udp_receiver_check(struct fl_block *block, const char *local_address, struct fl_strings from);

/* `length`: of the payload. `keys`: as of UDP_KEYS_PARAMETER; with a file, only messages that it authenticates are
 * taken. */
int udp_receiver_open(struct udp_receiver *receiver, struct fl_block *block, const char *local_address, int64_t port,
                      const char *interface, struct fl_strings from, double failover, size_t length, const char *keys);

/* Write the outputs UDP_RECEIVER_OUTPUTS, of which `dropped` is number `first`. */
void udp_receiver_outputs(const struct udp_receiver *receiver, struct fl_block *block, uint32_t first);

/* Write the outputs UDP_KEYS_OUTPUTS, of which `forged` is number `first`. */
void udp_keys_outputs(const struct udp_receiver *receiver, struct fl_block *block, uint32_t first);

/* The time of arrival of a datagram on CLOCK_MONOTONIC. The kernel stamps by the wall clock, which may be set at any
 * time. So the result is limited to the possible interval, from when the queue was last empty until now. */
int64_t udp_arrival_ns(int64_t stamp_ns, int64_t wall_ns, int64_t now_ns, int64_t emptied_ns);

/* Take the next datagram of the right length from one of the senders: `bytes` has room for the payload. What is looked
 * at is taken off `budget`; with none left there is none. `arrived_ns` is when the kernel received it (SO_TIMESTAMPNS,
 * see socket(7)), on CLOCK_MONOTONIC; for the first moments after the first socket of a computer asked for time stamps,
 * when it was read. */
bool udp_receive(struct udp_receiver *receiver, void *bytes, int64_t *arrived_ns, struct udp_budget *budget);

void udp_receiver_close(struct udp_receiver *receiver);

#endif
