/* The air between simulated radios (mac80211_hwsim): one 802.11 channel with DCF, by IEEE 802.11-2007, clause 9.
 *
 * The driver hands over each frame that a radio sends, and who carries it says who hears it when, and how it went. All
 * radios hear each other. Whose countdowns end in the same slot collide; nobody reads anything then. Each receiver
 * loses a frame by chance besides. Times are those of a cell of 802.11g, long slot, no protection; RTS and QoS are not
 * used. Chance is from a fixed seed: in virtual time a run repeats to the byte. */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/genetlink.h>
#include <linux/netlink.h>
#include <poll.h>
#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

/* drivers/net/wireless/virtual/mac80211_hwsim.h, which is no header of the kernel's for programs. */
enum { REGISTER = 1, FRAME = 2, TX_INFO_FRAME = 3 };
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
    ATTRIBUTES = 32
};
enum { NO_ACK = 1 << 1, ACKNOWLEDGED = 1 << 2 };

enum { RADIOS = 64, WAITING = 128, LONGEST = 2400, RATES = 4, ADDRESS = 6, SIGNAL_DBM = -50 };
enum {
    SLOT_NS = 20000,
    SIFS_NS = 10000,
    DIFS_NS = SIFS_NS + 2 * SLOT_NS,
    CW_MIN = 31,
    CW_MAX = 1023,
    ACK_BYTES = 14,
    FCS_BYTES = 4
};
static const int RATES_100KBIT_S[] = {10, 20, 55, 110, 60, 90, 120, 180, 240, 360, 480, 540};
enum { RATE_COUNT = sizeof RATES_100KBIT_S / sizeof *RATES_100KBIT_S, CCK_RATES = 4 };

struct rate {
    int8_t index; /* -1: none */
    uint8_t count;
};

struct frame {
    uint8_t content[LONGEST];
    int length;
    uint8_t transmitter[ADDRESS];
    uint32_t flags, frequency;
    uint64_t cookie;
    struct rate rates[RATES];
    int attempts; /* so far */
};

struct radio {
    struct frame *queue[WAITING];
    int first, count;
    int window, backoff; /* slots */
};

static struct {
    int socket, family;
    uint32_t sequence;
    int radio_count;
    double loss;
    struct radio radios[RADIOS];
    int64_t idle_ns; /* since when the channel is; in the future while it is taken */
    bool taken;
    bool sends[RADIOS]; /* those whose frames are on the air */
    uint64_t chance;
    struct {
        unsigned long frames, attempts[RATE_COUNT], collisions, lost, given_up, dropped;
        int64_t taken_ns;
    } counts;
} air;

static volatile sig_atomic_t ended;

static void end_it(int number)
{
    ended = number;
}

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000LL + now.tv_nsec;
}

static double chance(void)
{
    air.chance = air.chance * 6364136223846793005ULL + 1442695040888963407ULL; /* Knuth's MMIX */
    return (double)(air.chance >> 11) / 9007199254740992.0;
}

static int backoff(int window)
{
    return (int)(chance() * (window + 1));
}

/* What a frame takes on the air, its check sequence included; `rate`: its place in RATES_100KBIT_S. */
__attribute__((visibility("default"))) int64_t air_ns(int bytes, unsigned rate);

int64_t air_ns(int bytes, unsigned rate)
{
    int rate_100kbit_s = RATES_100KBIT_S[rate];
    if (rate < CCK_RATES) /* long preamble and header; 18.3.4: whole microseconds */
        return (192 + (80LL * bytes + rate_100kbit_s - 1) / rate_100kbit_s) * 1000;
    int bits = rate_100kbit_s * 4 / 10; /* of a symbol */
    return (20 + 4LL * ((16 + 8 * bytes + 6 + bits - 1) / bits) + 6) * 1000;
}

/* --- netlink --- */

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
                                .nlmsg_seq = ++air.sequence};
    *generic = (struct genlmsghdr){.cmd = (uint8_t)command, .version = 1};
    return header;
}

static int hand_over(struct nlmsghdr *message)
{
    return send(air.socket, message, message->nlmsg_len, 0) < 0 ? -errno : 0;
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
    return (int)recv(air.socket, buffer, (size_t)size, MSG_DONTWAIT);
}

static int family_of(const char *name)
{
    struct nlmsghdr *ask = message(GENL_ID_CTRL, CTRL_CMD_GETFAMILY);
    put(ask, CTRL_ATTR_FAMILY_NAME, name, (int)strlen(name) + 1);
    if (hand_over(ask) < 0)
        return -1;
    static _Alignas(8) char buffer[8192];
    struct pollfd waits = {.fd = air.socket, .events = POLLIN};
    if (poll(&waits, 1, 5000) <= 0 || receive(buffer, sizeof buffer) <= 0)
        return -1;
    const struct nlmsghdr *answer = (const void *)buffer;
    if (answer->nlmsg_type == NLMSG_ERROR)
        return -1;
    const struct nlattr *found[ATTRIBUTES];
    attributes(answer, found);
    return found[CTRL_ATTR_FAMILY_ID] ? *(const uint16_t *)data(found[CTRL_ATTR_FAMILY_ID]) : -1;
}

/* --- frames --- */

/* Radio N of the module has the address 42:00:00:00:NN:00, and its interface 02:00:00:00:NN:00. */
static int number_of(const uint8_t *address)
{
    int number = address[3] << 8 | address[4];
    return number < air.radio_count ? number : -1;
}

static void deliver(const struct frame *frame, int receiver, unsigned rate)
{
    uint8_t address[ADDRESS] = {0x42, 0, 0, (uint8_t)(receiver >> 8), (uint8_t)receiver, 0};
    struct nlmsghdr *arrival = message(air.family, FRAME);
    put(arrival, RECEIVER, address, ADDRESS);
    put(arrival, CONTENT, frame->content, frame->length);
    put_u32(arrival, RX_RATE, rate);
    put_u32(arrival, SIGNAL, (uint32_t)SIGNAL_DBM);
    put_u32(arrival, FREQUENCY, frame->frequency);
    hand_over(arrival);
}

static bool to_group(const struct frame *frame)
{
    return frame->content[4] & 1;
}

/* Attempts that the radio allows; at least one. */
static int allowed(const struct frame *frame)
{
    int sum = 0;
    for (int i = 0; i < RATES && frame->rates[i].index >= 0; i++)
        sum += frame->rates[i].count;
    return sum ? sum : 1;
}

/* The rate of the next attempt; the lowest where the radio has said none. */
static unsigned rate_of(const struct frame *frame)
{
    int left = frame->attempts;
    for (int i = 0; i < RATES && frame->rates[i].index >= 0; i++) {
        if (left < frame->rates[i].count)
            return frame->rates[i].index < RATE_COUNT ? (unsigned)frame->rates[i].index : 0;
        left -= frame->rates[i].count;
    }
    return 0;
}

static void report(struct frame *frame, bool acknowledged)
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
    struct nlmsghdr *fate = message(air.family, TX_INFO_FRAME);
    put(fate, TRANSMITTER, frame->transmitter, ADDRESS);
    put_u32(fate, FLAGS, frame->flags | (acknowledged ? ACKNOWLEDGED : 0));
    put_u32(fate, SIGNAL, (uint32_t)SIGNAL_DBM);
    put(fate, TX_INFO, used, sizeof used);
    put(fate, COOKIE, &frame->cookie, sizeof frame->cookie);
    hand_over(fate);
}

static void begin_anew(struct radio *radio)
{
    free(radio->queue[radio->first]);
    radio->first = (radio->first + 1) % WAITING;
    radio->count--;
    radio->window = CW_MIN;
    radio->backoff = backoff(radio->window);
}

/* The frame's attempt has ended; the others' may have spoiled it. */
static void end(int sender, bool collided)
{
    struct radio *radio = &air.radios[sender];
    struct frame *frame = radio->queue[radio->first];
    unsigned rate = rate_of(frame);
    frame->attempts++;
    if (to_group(frame) || frame->flags & NO_ACK) {
        for (int other = 0; !collided && other < air.radio_count; other++) {
            if (other == sender)
                continue;
            if (chance() < air.loss)
                air.counts.lost++;
            else
                deliver(frame, other, rate);
        }
        report(frame, false);
        begin_anew(radio);
        return;
    }
    int receiver = number_of(frame->content + 4);
    if (!collided && receiver >= 0 && chance() >= air.loss) {
        deliver(frame, receiver, rate);
        report(frame, true);
        begin_anew(radio);
    } else if (frame->attempts >= allowed(frame)) {
        air.counts.given_up++;
        report(frame, false);
        begin_anew(radio);
    } else {
        radio->window = radio->window * 2 + 1 > CW_MAX ? CW_MAX : radio->window * 2 + 1;
        radio->backoff = backoff(radio->window);
    }
}

/* Slots that were counted down since the channel is idle, DIFS first. */
static int counted(int64_t now)
{
    int64_t passed = now - air.idle_ns - DIFS_NS;
    return passed < 0 ? 0 : (int)(passed / SLOT_NS);
}

/* Who waits has counted so far; the rest is counted from `now` on, without another DIFS. */
static void settle(int64_t now)
{
    int slots = counted(now);
    for (int i = 0; i < air.radio_count; i++)
        if (air.radios[i].count)
            air.radios[i].backoff = air.radios[i].backoff > slots ? air.radios[i].backoff - slots : 0;
    air.idle_ns += (int64_t)slots * SLOT_NS;
}

static int least(void)
{
    int found = -1;
    for (int i = 0; i < air.radio_count; i++)
        if (air.radios[i].count && (found < 0 || air.radios[i].backoff < found))
            found = air.radios[i].backoff;
    return found;
}

/* When something happens next; -1: never. */
static int64_t next_ns(void)
{
    if (air.taken)
        return air.idle_ns;
    int slots = least();
    return slots < 0 ? -1 : air.idle_ns + DIFS_NS + (int64_t)slots * SLOT_NS;
}

static void happen(int64_t now)
{
    if (air.taken) {
        int senders = 0;
        for (int i = 0; i < air.radio_count; i++)
            senders += air.sends[i];
        air.counts.collisions += senders > 1;
        air.taken = false;
        for (int i = 0; i < air.radio_count; i++)
            if (air.sends[i]) {
                air.sends[i] = false;
                end(i, senders > 1);
            }
        return;
    }
    int64_t begin = next_ns(), longest = 0;
    int slots = least();
    for (int i = 0; i < air.radio_count; i++) {
        struct radio *radio = &air.radios[i];
        if (!radio->count)
            continue;
        radio->backoff -= slots;
        if (radio->backoff)
            continue;
        air.sends[i] = true;
        const struct frame *frame = radio->queue[radio->first];
        air.counts.attempts[rate_of(frame)]++;
        int64_t takes = air_ns(frame->length + FCS_BYTES, rate_of(frame));
        if (!to_group(frame) && !(frame->flags & NO_ACK))
            takes += SIFS_NS + air_ns(ACK_BYTES, 0);
        longest = takes > longest ? takes : longest;
    }
    /* A radio that is late in virtual time is late on the air: nothing is sent in the past. */
    begin = begin < now - SLOT_NS ? now : begin;
    air.taken = true;
    air.idle_ns = begin + longest;
    air.counts.taken_ns += longest;
}

static void take(const struct nlmsghdr *message)
{
    const struct nlattr *found[ATTRIBUTES];
    attributes(message, found);
    if (!found[TRANSMITTER] || !found[CONTENT] || !found[FLAGS] || !found[TX_INFO] || !found[COOKIE])
        return;
    int sender = number_of(data(found[TRANSMITTER])), length = found[CONTENT]->nla_len - NLA_HDRLEN;
    if (sender < 0 || length > LONGEST)
        return;
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
    struct radio *radio = &air.radios[sender];
    air.counts.frames++;
    if (radio->count == WAITING) {
        air.counts.dropped++;
        report(frame, false);
        free(frame);
        return;
    }
    int64_t now = now_ns();
    if (!radio->count) {
        bool idle = !air.taken && now >= air.idle_ns + DIFS_NS;
        if (!air.taken)
            settle(now);
        /* 9.2.5.1: at once where the channel was idle long enough; the slot begins with the next of those who count. */
        radio->backoff = idle && least() < 0 ? 0 : backoff(radio->window);
        if (idle && least() < 0)
            air.idle_ns = now - DIFS_NS;
    }
    radio->queue[(radio->first + radio->count++) % WAITING] = frame;
}

/* Carry frames between the first `radios` of the module until SIGTERM. 0 to 1 of the attempts get lost. Returns 0, or a
 * number of errno.h where the driver does not give them over; `ready` is written to once it does. */
__attribute__((visibility("default"))) int carry(int radios, double loss, int ready)
{
    if (radios < 1 || radios > RADIOS)
        return EINVAL;
    air.radio_count = radios;
    air.loss = loss;
    air.chance = 1;
    for (int i = 0; i < radios; i++)
        air.radios[i].window = CW_MIN;
    air.socket = socket(AF_NETLINK, SOCK_RAW | SOCK_CLOEXEC, NETLINK_GENERIC);
    int room = 8 << 20;
    setsockopt(air.socket, SOL_SOCKET, SO_RCVBUFFORCE, &room, sizeof room);
    struct sockaddr_nl here = {.nl_family = AF_NETLINK};
    if (air.socket < 0 || bind(air.socket, (struct sockaddr *)&here, sizeof here) < 0)
        return errno;
    air.family = family_of("MAC80211_HWSIM");
    if (air.family < 0)
        return ENODEV;
    struct nlmsghdr *wish = message(air.family, REGISTER);
    wish->nlmsg_flags |= NLM_F_ACK;
    if (hand_over(wish) < 0)
        return errno;
    sigset_t term, usual;
    sigemptyset(&term);
    sigaddset(&term, SIGTERM);
    sigprocmask(SIG_BLOCK, &term, &usual);
    sigdelset(&usual, SIGTERM);
    sigaction(SIGTERM, &(struct sigaction){.sa_handler = end_it}, NULL);
    static _Alignas(8) char buffer[65536];
    bool registered = false;
    while (!ended) {
        int64_t due = next_ns(), wait = due < 0 ? -1 : due - now_ns();
        if (due >= 0 && wait <= 0) {
            happen(now_ns());
            continue;
        }
        struct timespec pause = {.tv_sec = wait / 1000000000, .tv_nsec = wait % 1000000000};
        struct pollfd waits = {.fd = air.socket, .events = POLLIN};
        if (ppoll(&waits, 1, due < 0 ? NULL : &pause, &usual) < 0 && errno != EINTR)
            return errno;
        int length;
        while ((length = receive(buffer, sizeof buffer)) > 0) {
            const struct nlmsghdr *each = (const void *)buffer;
            for (int left = length; NLMSG_OK(each, (unsigned)left); each = NLMSG_NEXT(each, left)) {
                if (each->nlmsg_type == NLMSG_ERROR) {
                    const struct nlmsgerr *error = NLMSG_DATA(each);
                    if (!registered && error->error)
                        return -error->error;
                    if (!registered)
                        (void)!write(ready, "\n", 1);
                    registered = true;
                } else if (each->nlmsg_type == air.family) {
                    take(each);
                }
            }
        }
    }
    return 0;
}

/* What happened so far, as JSON; attempts by rates in 100 kbit/s. */
__attribute__((visibility("default"))) void tell(char *text, int size)
{
    int length = snprintf(text, (size_t)size,
                          "{\"frames\": %lu, \"collisions\": %lu, \"lost\": %lu, \"given_up\": %lu, \"dropped\": %lu, "
                          "\"taken_s\": %.6f, \"attempts\": {",
                          air.counts.frames, air.counts.collisions, air.counts.lost, air.counts.given_up,
                          air.counts.dropped, (double)air.counts.taken_ns / 1e9);
    for (int rate = 0; rate < RATE_COUNT; rate++)
        length += snprintf(text + length, (size_t)(size - length), "%s\"%d\": %lu", rate ? ", " : "",
                           RATES_100KBIT_S[rate], air.counts.attempts[rate]);
    snprintf(text + length, (size_t)(size - length), "}}");
}
