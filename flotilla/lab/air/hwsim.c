/* mac80211_hwsim by generic netlink. Its numbers are those of drivers/net/wireless/virtual/mac80211_hwsim.h, which is
 * no header of the kernel's for programs. */
#define _GNU_SOURCE
#include "hwsim.h"

#include <errno.h>
#include <linux/genetlink.h>
#include <linux/netlink.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>

enum { REGISTER = 1, FRAME = 2, TX_INFO_FRAME = 3, NEW_RADIO = 4 };
enum {
    RECEIVER = 1,
    TRANSMITTER = 2,
    CONTENT = 3,
    FLAGS = 4,
    RX_RATE = 5,
    SIGNAL = 6,
    TX_INFO = 7,
    COOKIE = 8,
    FREQUENCY = 19,
    PERMANENT_ADDRESS = 22,
    ATTRIBUTES = 32
};
enum { SIGNAL_DBM = -50 };

static struct {
    int socket, family;
    uint32_t sequence;
} driver;

static void put(struct nlmsghdr *message, int type, const void *data, int length)
{
    struct nlattr *attribute = (void *)((char *)message + NLMSG_ALIGN(message->nlmsg_len));
    attribute->nla_type = (uint16_t)type;
    attribute->nla_len = (uint16_t)(NLA_HDRLEN + length);
    memcpy((char *)attribute + NLA_HDRLEN, data, (size_t)length);
    message->nlmsg_len = NLMSG_ALIGN(message->nlmsg_len) + NLA_ALIGN(attribute->nla_len);
}

static void put_u32(struct nlmsghdr *message, int type, uint32_t value)
{
    put(message, type, &value, sizeof value);
}

static struct nlmsghdr *message(int family, int command)
{
    static _Alignas(8) char buffer[LONGEST + 512];
    memset(buffer, 0, sizeof buffer);
    struct nlmsghdr *header = (void *)buffer;
    struct genlmsghdr *generic = NLMSG_DATA(header);
    *header = (struct nlmsghdr){.nlmsg_len = NLMSG_LENGTH(GENL_HDRLEN),
                                .nlmsg_type = (uint16_t)family,
                                .nlmsg_flags = NLM_F_REQUEST,
                                .nlmsg_seq = ++driver.sequence};
    *generic = (struct genlmsghdr){.cmd = (uint8_t)command, .version = 1};
    return header;
}

static int hand_over(struct nlmsghdr *message)
{
    return send(driver.socket, message, message->nlmsg_len, 0) < 0 ? -errno : 0;
}

static void attributes(const struct nlmsghdr *message, const struct nlattr *found[ATTRIBUTES])
{
    memset(found, 0, ATTRIBUTES * sizeof *found);
    const char *at = (const char *)message + NLMSG_LENGTH(GENL_HDRLEN),
               *end = (const char *)message + message->nlmsg_len;
    while (end - at >= NLA_HDRLEN) {
        const struct nlattr *attribute = (const void *)at;
        if (attribute->nla_len < NLA_HDRLEN)
            return;
        if ((attribute->nla_type & NLA_TYPE_MASK) < ATTRIBUTES)
            found[attribute->nla_type & NLA_TYPE_MASK] = attribute;
        at += NLA_ALIGN(attribute->nla_len);
    }
}

static const void *data(const struct nlattr *attribute)
{
    return (const char *)attribute + NLA_HDRLEN;
}

static int receive(char *buffer, int size)
{
    return (int)recv(driver.socket, buffer, (size_t)size, MSG_DONTWAIT);
}

static int family_of(const char *name)
{
    struct nlmsghdr *ask = message(GENL_ID_CTRL, CTRL_CMD_GETFAMILY);
    put(ask, CTRL_ATTR_FAMILY_NAME, name, (int)strlen(name) + 1);
    if (hand_over(ask) < 0)
        return -1;
    static _Alignas(8) char buffer[8192];
    struct pollfd waits = {.fd = driver.socket, .events = POLLIN};
    if (poll(&waits, 1, 5000) <= 0 || receive(buffer, sizeof buffer) <= 0)
        return -1;
    const struct nlmsghdr *answer = (const void *)buffer;
    if (answer->nlmsg_type == NLMSG_ERROR)
        return -1;
    const struct nlattr *found[ATTRIBUTES];
    attributes(answer, found);
    return found[CTRL_ATTR_FAMILY_ID] ? *(const uint16_t *)data(found[CTRL_ATTR_FAMILY_ID]) : -1;
}

void hwsim_deliver(const struct frame *frame, const uint8_t address[ADDRESS], unsigned rate)
{
    struct nlmsghdr *arrival = message(driver.family, FRAME);
    put(arrival, RECEIVER, address, ADDRESS);
    put(arrival, CONTENT, frame->content, frame->length);
    put_u32(arrival, RX_RATE, rate);
    put_u32(arrival, SIGNAL, (uint32_t)SIGNAL_DBM);
    put_u32(arrival, FREQUENCY, frame->frequency);
    hand_over(arrival);
}

void hwsim_report(const struct frame *frame, bool acknowledged)
{
    struct rate used[RATES];
    int left = frame->attempts;
    for (int i = 0; i < RATES; i++) {
        used[i] = frame->rates[i];
        if (left <= 0 || used[i].index < 0)
            used[i] = (struct rate){.index = -1};
        else if (left < used[i].count)
            used[i].count = (uint8_t)left;
        left -= frame->rates[i].count;
    }
    struct nlmsghdr *fate = message(driver.family, TX_INFO_FRAME);
    put(fate, TRANSMITTER, frame->transmitter, ADDRESS);
    put_u32(fate, FLAGS, frame->flags | (acknowledged ? ACKNOWLEDGED : 0));
    put_u32(fate, SIGNAL, (uint32_t)SIGNAL_DBM);
    put(fate, TX_INFO, used, sizeof used);
    put(fate, COOKIE, &frame->cookie, sizeof frame->cookie);
    hand_over(fate);
}

/* A frame that a radio sends; NULL: the message is none. */
static struct frame *frame_of(const struct nlmsghdr *message)
{
    const struct nlattr *found[ATTRIBUTES];
    attributes(message, found);
    if (!found[TRANSMITTER] || !found[CONTENT] || !found[FLAGS] || !found[TX_INFO] || !found[COOKIE])
        return NULL;
    int length = found[CONTENT]->nla_len - NLA_HDRLEN;
    if (length > LONGEST)
        return NULL;
    struct frame *frame = calloc(1, sizeof *frame);
    if (!frame)
        abort();
    frame->length = length;
    memcpy(frame->content, data(found[CONTENT]), (size_t)length);
    memcpy(frame->transmitter, data(found[TRANSMITTER]), ADDRESS);
    memcpy(frame->rates, data(found[TX_INFO]), sizeof frame->rates);
    memcpy(&frame->flags, data(found[FLAGS]), sizeof frame->flags);
    memcpy(&frame->cookie, data(found[COOKIE]), sizeof frame->cookie);
    if (found[FREQUENCY])
        memcpy(&frame->frequency, data(found[FREQUENCY]), sizeof frame->frequency);
    return frame;
}

/* Send a wish and wait for the driver's answer: 0, or a number of errno.h. */
static int wish(struct nlmsghdr *message)
{
    message->nlmsg_flags |= NLM_F_ACK;
    int status = hand_over(message);
    static _Alignas(8) char buffer[8192];
    struct pollfd waits = {.fd = driver.socket, .events = POLLIN};
    while (!status) {
        if (poll(&waits, 1, 5000) <= 0)
            return ETIMEDOUT;
        if (receive(buffer, sizeof buffer) <= 0)
            continue;
        const struct nlmsghdr *answer = (const void *)buffer;
        if (answer->nlmsg_type == NLMSG_ERROR) {
            /* A new radio's number is its "error". */
            int error = ((const struct nlmsgerr *)NLMSG_DATA(answer))->error;
            return error < 0 ? -error : 0;
        }
    }
    return -status;
}

int hwsim_open(void)
{
    driver.socket = socket(AF_NETLINK, SOCK_RAW | SOCK_CLOEXEC, NETLINK_GENERIC);
    int room = 8 << 20;
    setsockopt(driver.socket, SOL_SOCKET, SO_RCVBUFFORCE, &room, sizeof room);
    struct sockaddr_nl here = {.nl_family = AF_NETLINK};
    if (driver.socket < 0 || bind(driver.socket, (struct sockaddr *)&here, sizeof here) < 0)
        return errno;
    driver.family = family_of("MAC80211_HWSIM");
    return driver.family < 0 ? ENODEV : 0;
}

int hwsim_register(void)
{
    return wish(message(driver.family, REGISTER));
}

int hwsim_new_radio(const uint8_t address[ADDRESS])
{
    struct nlmsghdr *radio = message(driver.family, NEW_RADIO);
    put(radio, PERMANENT_ADDRESS, address, ADDRESS);
    return wish(radio);
}

int hwsim_socket(void)
{
    return driver.socket;
}

void hwsim_read(void (*take)(struct frame *frame))
{
    static _Alignas(8) char buffer[65536];
    int length;
    while ((length = receive(buffer, sizeof buffer)) > 0) {
        const struct nlmsghdr *each = (const void *)buffer;
        for (int left = length; NLMSG_OK(each, (unsigned)left); each = NLMSG_NEXT(each, left)) {
            struct frame *frame = each->nlmsg_type == driver.family ? frame_of(each) : NULL;
            if (frame)
                take(frame);
        }
    }
}
