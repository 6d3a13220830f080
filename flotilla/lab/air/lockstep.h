/* What guests in lock-step and their conductor share: a mailbox for each guest, in memory that all map.
 *
 * All guests have one clock: QEMU's virtual time since power on, which is also their time stamp counter. It is cut into
 * quanta. At the end of each, a guest stands still until the others are there too; meanwhile the conductor takes what
 * their radios sent, and lays out what they hear. */
#pragma once

#include <stdatomic.h>
#include <stddef.h>

#include "channel.h"

enum { MAILBOX_BYTES = 1 << 20, MESSAGES = 128 };

/* What a quantum takes: no frame at 11 Mbit/s and below ends sooner after it began, with its
 * acknowledgement. */
#define QUANTUM_NS 500000LL
/* Until all guests have radios. */
#define LONG_QUANTUM_NS 10000000LL

enum kind { SENT, HEARD, REPORTED };

struct message {
    _Alignas(8) int64_t at_ns;
    uint32_t kind;
    uint32_t radio; /* that sends, hears, or has sent */
    uint32_t rate, acknowledged;
    struct frame frame;
};

/* A ring: one side writes messages and `head`, the other one `tail`. Both count on. */
struct messages {
    uint32_t head, tail;
    struct message ring[MESSAGES];
};

struct mailbox {
    _Atomic uint32_t waits;      /* 1: the guest does, and all of this is the conductor's */
    uint32_t joined;             /* the guest has radios */
    uint32_t leaves;             /* the guest wishes that all end */
    uint32_t ended;              /* all do */
    uint32_t full;               /* messages for which there was no room */
    _Alignas(8) int64_t next_ns; /* end of the quantum that begins */
    struct messages out, in;
};

_Static_assert(sizeof(struct mailbox) <= MAILBOX_BYTES, "a mailbox is more than its memory");
/* A guest may have 32 bits; its conductor has 64. */
_Static_assert(offsetof(struct message, frame) == 24 && offsetof(struct frame, content) == 38 &&
                   sizeof(struct frame) == 2440 && offsetof(struct mailbox, out) == 32,
               "a mailbox is not the same on both sides");

/* Room for a message; NULL where there is none. It is sent when `head` is one more. */
static inline struct message *room(struct messages *messages)
{
    return messages->head - messages->tail == MESSAGES ? NULL : &messages->ring[messages->head % MESSAGES];
}

/* The first message; NULL where there is none. It is gone when `tail` is one more. */
static inline struct message *first(struct messages *messages)
{
    return messages->head == messages->tail ? NULL : &messages->ring[messages->tail % MESSAGES];
}

/* What of a frame has to be copied. */
static inline size_t frame_bytes(const struct frame *frame)
{
    return offsetof(struct frame, content) + (size_t)frame->length;
}
