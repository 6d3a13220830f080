/** udp-send
 *
 * Sends a datagram in each step, or whenever `sequence` changes, to one computer, to several, or to all in reach.
 *
 * Failure: No step waits. A datagram that the network does not take (interface or route missing, queue full) is
 * counted in `failed`, and not sent again. The interface and the local address may come later, go, and come back.
 * While `withhold` is 1 the block is silent, so that receivers fail over.
 *
 * With `keys` each message carries 40 bytes more, which prove to its receiver that it is from here and new. A receiver
 * takes messages from the second on: to the first it answers with what the next ones have to repeat. Answers that are
 * not the receiver's are not taken, and counted in `forged`, at most four for each address in a step that sends.
 */
#define _GNU_SOURCE
#include "core/udp.h"

#include <arpa/inet.h>
#include <errno.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

struct udp_send {
    struct fl_strings address;
    int64_t port;
    UDP_LOCAL_MEMBERS;
    UDP_KEYS_MEMBER;
    int64_t length;
    bool broadcast;
    int64_t dscp;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct udp_send, address, .summary = "IPv4 address to send to, or several"),
    FL_PARAMETER(struct udp_send, port, .min = 1, .max = 65535, .summary = "UDP port to send to"),
    UDP_LOCAL_PARAMETERS(struct udp_send),
    UDP_KEYS_PARAMETER(struct udp_send),
    FL_PARAMETER(struct udp_send, length, .min = 1, .max = UDP_LONGEST, .unit = "B",
                 .summary = "payload of a datagram; it has to fit one frame"),
    FL_PARAMETER(struct udp_send, broadcast, .default_value = "false",
                 .summary = "whether `address` may be the broadcast address of a network"),
    FL_PARAMETER(struct udp_send, dscp, .default_value = "0", .min = 0, .max = 63,
                 .summary = "class of service (RFC 2474); 802.11 sends 46, voice, first"),
};

static const struct fl_port inputs[] = {
    {.name = "withhold", .type = FL_BOOLEAN, .width = 1, .flags = FL_OPTIONAL, .summary = "1: nothing is sent"},
    {.name = "sequence",
     .type = FL_UINT32,
     .width = 1,
     .flags = FL_OPTIONAL,
     .summary = "sequence of the input that the data are made from: send only when it has changed"},
};

static const struct fl_port outputs[] = {
    {.name = "sent", .type = FL_UINT32, .width = 1, .summary = "datagrams handed to the network so far"},
    {.name = "failed",
     .type = FL_UINT32,
     .width = 1,
     .summary = "datagrams the network did not take: not there, no route, or full"},
    {.name = "forged",
     .type = FL_UINT32,
     .width = 1,
     .flags = FL_REFUSALS,
     .summary = "answers that no key of `keys` proves"},
};

enum { WITHHOLD, SEQUENCE, DATA };
enum { SENT, FAILED, FORGED };

/* One socket for each address: datagrams that wait for the hardware address of a missing computer fill their socket. */
struct state {
    struct udp_sockets sockets;
    uint32_t sequence; /* sequence in the step before; 0: nothing has come yet, or the input has no wire */
    struct sockaddr_in to[FL_SENDERS];
    struct authentication_sender authentication[FL_SENDERS];
    uint8_t *message; /* payload, and a trailer for each address in turn; NULL: not authenticated */
};

static int configure(struct fl_block *block)
{
    const struct udp_send *udp = block->parameters;
    struct in_addr to[FL_SENDERS], local;
    if (udp_read_addresses(block, "address", udp->address, to) != FL_OK ||
        udp_read_address(block, "local_address", udp->local_address, &local) != FL_OK)
        return FL_FAILED;
    for (size_t i = 0; i < udp->address.count; i++) {
        if (to[i].s_addr == INADDR_ANY)
            return fl_fail(block, "parameter address: 0.0.0.0 is not an address to send to");
        if (to[i].s_addr == INADDR_BROADCAST && !udp->broadcast)
            return fl_fail(block, "parameter address: %s is a broadcast address; allow it by broadcast: true",
                           udp->address.value[i]);
    }
    if (*udp->keys && udp->broadcast)
        return fl_fail(block, "parameter keys: a broadcast goes to many computers, and each has a key of its own");
    if (udp_check_keys(block, "address", udp->keys, udp->length, udp->address) != FL_OK)
        return FL_FAILED;
    return fl_add_input(block, (struct fl_port){.name = "data",
                                                .type = FL_UINT8,
                                                .width = (uint32_t)udp->length,
                                                .summary = "payload, sent each step"});
}

/* Only the routes of this computer say which addresses are broadcasts. Connecting a separate socket checks that, and
 * sends nothing. Without a route there may be one later, so that is not a failure. */
static int refuse_broadcast(struct fl_block *block, const struct sockaddr_in *to, const char *address)
{
    int fd = socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    if (fd < 0)
        return fl_fail(block, "cannot open a UDP socket: %s", strerror(errno));
    bool refused = connect(fd, (const struct sockaddr *)to, sizeof *to) < 0 && errno == EACCES;
    close(fd);
    if (refused)
        return fl_fail(block, "%s is the broadcast address of a network; allow it by broadcast: true", address);
    return FL_OK;
}

static bool prepare(int fd, const void *context)
{
    const struct udp_send *udp = context;
    int on = udp->broadcast, service = (int)udp->dscp << 2; /* above the two bits of congestion notification */
    return setsockopt(fd, SOL_SOCKET, SO_BROADCAST, &on, sizeof on) == 0 &&
           setsockopt(fd, IPPROTO_IP, IP_TOS, &service, sizeof service) == 0;
}

static int begin_sessions(struct fl_block *block, const struct in_addr *to)
{
    const struct udp_send *udp = block->parameters;
    struct state *state = block->state;
    uint8_t key[AUTHENTICATION_KEY];
    for (size_t i = 0; i < udp->address.count; i++) {
        if (authentication_read_key(block, udp->keys, to[i], AUTHENTICATION_TO, key) != FL_OK)
            return FL_FAILED;
        authentication_sender_begin(&state->authentication[i], key, (uint16_t)udp->port);
    }
    explicit_bzero(key, sizeof key);
    state->message = fl_allocate(block, (size_t)udp->length + AUTHENTICATION_TRAILER);
    return state->message ? FL_OK : FL_FAILED;
}

static int start(struct fl_block *block)
{
    const struct udp_send *udp = block->parameters;
    struct state *state = block->state;
    struct in_addr to[FL_SENDERS], local;
    if (udp_read_addresses(block, "address", udp->address, to) != FL_OK ||
        udp_read_address(block, "local_address", udp->local_address, &local) != FL_OK)
        return FL_FAILED;
    for (size_t i = 0; i < udp->address.count; i++) {
        state->to[i] =
            (struct sockaddr_in){.sin_family = AF_INET, .sin_port = htons((uint16_t)udp->port), .sin_addr = to[i]};
        if (!udp->broadcast && refuse_broadcast(block, &state->to[i], udp->address.value[i]) != FL_OK)
            return FL_FAILED;
    }
    if (*udp->keys && begin_sessions(block, to) != FL_OK)
        return FL_FAILED;
    state->sockets.prepare = prepare;
    state->sockets.context = udp;
    return udp_sockets_open(&state->sockets, block, udp->address.count, local, 0, udp->interface);
}

/* Take what the receiver wants to be answered; of what others send, a few each step. How many of these are forged. */
static uint32_t take_challenges(int fd, struct authentication_sender *authentication)
{
    enum { MOST = 4 };
    uint8_t bytes[AUTHENTICATION_CHALLENGE + 1];
    ssize_t got;
    uint32_t forged = 0;
    for (int i = 0; i < MOST && (got = recv(fd, bytes, sizeof bytes, MSG_DONTWAIT)) >= 0; i++)
        forged += authentication_challenged(authentication, bytes, (size_t)got) == AUTHENTICATION_FORGED;
    return forged;
}

static ssize_t send_to(struct fl_block *block, size_t i)
{
    const struct udp_send *udp = block->parameters;
    struct state *state = block->state;
    const void *bytes = block->in[DATA];
    size_t length = (size_t)udp->length;
    if (state->message) {
        FL_OUT(block, FORGED, uint32_t) += take_challenges(state->sockets.fd[i], &state->authentication[i]);
        authentication_sign(&state->authentication[i], state->message, length);
        bytes = state->message;
        length += AUTHENTICATION_TRAILER;
    }
    return sendto(state->sockets.fd[i], bytes, length, MSG_DONTWAIT, (const struct sockaddr *)&state->to[i],
                  sizeof state->to[i]);
}

static int step(struct fl_block *block)
{
    const struct udp_send *udp = block->parameters;
    struct state *state = block->state;
    uint32_t before = state->sequence;
    state->sequence = FL_IN(block, SEQUENCE, uint32_t);
    if (FL_IN(block, WITHHOLD, uint8_t) || (before && before == state->sequence))
        return FL_OK;
    if (state->message)
        memcpy(state->message, block->in[DATA], (size_t)udp->length);
    for (size_t i = 0; i < udp->address.count; i++) {
        if (send_to(block, i) >= 0)
            FL_OUT(block, SENT, uint32_t)++;
        else
            FL_OUT(block, FAILED, uint32_t)++;
    }
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    udp_sockets_close(&state->sockets);
}

FL_BLOCK(udp_send) = {
    .abi = FL_ABI,
    .name = "udp-send",
    .summary = "sends a datagram each step, to one computer, several or all in reach: an input `data`, uint8",
    .source = "RFC 768; RFC 2474 for the class of service; Linux: udp(7), ip(7)",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct udp_send),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .terminate = terminate,
};
