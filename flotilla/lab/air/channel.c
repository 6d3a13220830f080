#include "channel.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { WAITING = 128 };
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

struct radio {
    struct frame *queue[WAITING];
    int first, count;
    int window, backoff; /* slots */
};

static struct {
    struct fates fates;
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

bool channel_open(int radios, double loss, struct fates fates)
{
    if (radios < 1 || radios > RADIOS)
        return false;
    for (int i = 0; i < RADIOS; i++)
        while (air.radios[i].count) {
            air.radios[i].count--;
            free(air.radios[i].queue[(air.radios[i].first + air.radios[i].count) % WAITING]);
        }
    memset(&air, 0, sizeof air);
    air.fates = fates;
    air.radio_count = radios;
    air.loss = loss;
    air.chance = 1;
    for (int i = 0; i < radios; i++)
        air.radios[i].window = CW_MIN;
    return true;
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

int64_t air_ns(int bytes, unsigned rate)
{
    int rate_100kbit_s = RATES_100KBIT_S[rate];
    if (rate < CCK_RATES) /* long preamble and header; 18.3.4: whole microseconds */
        return (192 + (80LL * bytes + rate_100kbit_s - 1) / rate_100kbit_s) * 1000;
    int bits = rate_100kbit_s * 4 / 10; /* of a symbol */
    return (20 + 4LL * ((16 + 8 * bytes + 6 + bits - 1) / bits) + 6) * 1000;
}

int channel_radio(const uint8_t *address)
{
    int number = radio_number(address);
    return number < air.radio_count ? number : -1;
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
                air.fates.deliver(frame, other, rate, air.idle_ns);
        }
        air.fates.report(frame, sender, false, air.idle_ns);
        begin_anew(radio);
        return;
    }
    int receiver = channel_radio(frame->content + 4);
    if (!collided && receiver >= 0 && chance() >= air.loss) {
        air.fates.deliver(frame, receiver, rate, air.idle_ns);
        air.fates.report(frame, sender, true, air.idle_ns);
        begin_anew(radio);
    } else if (frame->attempts >= allowed(frame)) {
        air.counts.given_up++;
        air.fates.report(frame, sender, false, air.idle_ns);
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

int64_t channel_next_ns(void)
{
    if (air.taken)
        return air.idle_ns;
    int slots = least();
    return slots < 0 ? -1 : air.idle_ns + DIFS_NS + (int64_t)slots * SLOT_NS;
}

bool channel_taken(void)
{
    return air.taken;
}

void channel_happen(int64_t now)
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
    int64_t begin = channel_next_ns(), longest = 0;
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

void channel_take(int sender, struct frame *frame, int64_t now)
{
    struct radio *radio = &air.radios[sender];
    air.counts.frames++;
    if (radio->count == WAITING) {
        air.counts.dropped++;
        air.fates.report(frame, sender, false, now);
        free(frame);
        return;
    }
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

void tell(char *text, int size)
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
