/* One 802.11 channel with DCF, by IEEE 802.11-2007, clause 9: queues of radios, backoff, collisions, retries.
 *
 * It has no clock: who uses it says when frames come, and has things happen when they are due. All radios hear each
 * other. Whose countdowns end in the same slot collide; nobody reads anything then. Each receiver loses a frame by
 * chance besides. Times are those of a cell of 802.11g, long slot, no protection; RTS and QoS are not used. Chance is
 * from a fixed seed, so a run of the same frames at the same times repeats to the byte. A process has one channel. */
#pragma once

#include <stdbool.h>
#include <stdint.h>

#define EXPORT __attribute__((visibility("default")))

enum { RADIOS = 64, LONGEST = 2400, RATES = 4, ADDRESS = 6 };
/* Of mac80211_hwsim's flags. */
enum { NO_ACK = 1 << 1, ACKNOWLEDGED = 1 << 2 };

struct rate {
    int8_t index; /* of rates_100kbit_s; -1: none */
    uint8_t count;
};

struct frame {
    _Alignas(8) uint64_t cookie; /* the driver's: by it the radio knows its frame again */
    uint32_t flags, frequency;
    struct rate rates[RATES];
    int attempts; /* so far */
    int length;   /* bytes, without the check sequence */
    uint8_t transmitter[ADDRESS];
    uint8_t content[LONGEST];
};

/* What the channel has done. `at_ns`: when the frame, or its acknowledgement, has ended on the air. */
struct fates {
    void (*deliver)(const struct frame *frame, int receiver, unsigned rate, int64_t at_ns);
    void (*report)(struct frame *frame, int sender, bool acknowledged, int64_t at_ns);
};

/* A new channel of the radios 0 to `radios` - 1; 0 to 1 of the attempts get lost. False: so many radios cannot be. */
bool channel_open(int radios, double loss, struct fates fates);

/* Radio N has the address ..:..:..:NN:NN:.. of the interface or of the driver. */
static inline int radio_number(const uint8_t address[ADDRESS])
{
    return address[3] << 8 | address[4];
}

/* The radio of an address; -1: none of the channel's. */
int channel_radio(const uint8_t *address);

/* A radio wants to send a frame, from now on. The channel frees the frame. */
void channel_take(int sender, struct frame *frame, int64_t now_ns);

/* When something happens next; -1: never, unless a frame comes. */
int64_t channel_next_ns(void);

/* A frame is on the air, so what happens next is its end, whatever comes meanwhile. */
bool channel_taken(void);

/* Have it happen. `now_ns`: nothing begins before it. */
void channel_happen(int64_t now_ns);

/* The rates of 2.4 GHz in the order in which Linux's drivers have them: what a frame takes on the air, its check
 * sequence included. */
EXPORT int64_t air_ns(int bytes, unsigned rate);

/* What happened so far, as JSON; attempts by rates in 100 kbit/s. */
EXPORT void tell(char *text, int size);
