/* The host's part in lock-step: it lets guests go on when all have come to the end of a quantum, and has the channel
 * carry what their radios sent.
 *
 * A frame takes a quantum or more, so one that began within the last quantum is heard in the next one or later: when
 * that is, is known before its time comes. A shorter one would be heard at the end of the quantum. The order of events
 * follows from their times and the guests' numbers, never from the host. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <linux/futex.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include "lockstep.h"

enum { GUESTS = 32 };

static struct {
    int guests;
    struct mailbox *boxes[GUESTS];
    int guest_of[RADIOS];
} all;

static void lay_out(int radio, enum kind kind, const struct frame *frame, unsigned rate, bool acknowledged,
                    int64_t at_ns)
{
    struct mailbox *box = all.boxes[all.guest_of[radio]];
    if (!box->joined)
        return; /* a radio that is not there yet hears nothing */
    struct message *message = room(&box->in);
    if (!message) {
        box->full++;
        return;
    }
    message->at_ns = at_ns;
    message->kind = kind;
    message->radio = (uint32_t)radio;
    message->rate = rate;
    message->acknowledged = acknowledged;
    memcpy(&message->frame, frame, frame_bytes(frame));
    box->in.head++;
}

static void deliver(const struct frame *frame, int receiver, unsigned rate, int64_t at_ns)
{
    lay_out(receiver, HEARD, frame, rate, false, at_ns);
}

static void report(struct frame *frame, int sender, bool acknowledged, int64_t at_ns)
{
    lay_out(sender, REPORTED, frame, 0, acknowledged, at_ns);
}

/* All that begins until `begins_ns`, and all that ends until `ends_ns`. */
static void happen(int64_t begins_ns, int64_t ends_ns)
{
    int64_t next;
    while ((next = channel_next_ns()) >= 0 && next <= (channel_taken() ? ends_ns : begins_ns))
        channel_happen(next);
}

/* The guest with the earliest message; of equal times, the first one. NULL: nobody has one. */
static struct mailbox *earliest(void)
{
    struct mailbox *from = NULL;
    for (int i = 0; i < all.guests; i++) {
        const struct message *message = first(&all.boxes[i]->out);
        if (message && (!from || message->at_ns < first(&from->out)->at_ns))
            from = all.boxes[i];
    }
    return from;
}

/* What was sent until now; what will be heard within a quantum is laid out. */
static void carry(int64_t now_ns)
{
    for (struct mailbox *box; (box = earliest()); box->out.tail++) {
        const struct message *message = first(&box->out);
        happen(message->at_ns, message->at_ns);
        struct frame *frame = malloc(sizeof *frame);
        if (!frame)
            abort();
        memcpy(frame, &message->frame, frame_bytes(&message->frame));
        channel_take((int)message->radio, frame, message->at_ns);
    }
    happen(now_ns, now_ns + QUANTUM_NS);
}

/* Until the guest waits. ETIMEDOUT: it does not, and `alive` says that it is none any more. */
static int await(struct mailbox *box, bool (*alive)(void))
{
    struct timespec second = {.tv_sec = 1};
    while (!atomic_load(&box->waits))
        if (syscall(SYS_futex, &box->waits, FUTEX_WAIT, 0, &second, NULL, 0) < 0 && errno == ETIMEDOUT && !alive())
            return ETIMEDOUT;
    return 0;
}

static void let_go(struct mailbox *box)
{
    atomic_store(&box->waits, 0);
    syscall(SYS_futex, &box->waits, FUTEX_WAKE, 1, NULL, NULL, 0);
}

static int quanta(int64_t longest_ns, bool (*alive)(void))
{
    bool end = false;
    for (int64_t now_ns = LONG_QUANTUM_NS; !end;) {
        bool joined = true;
        for (int i = 0; i < all.guests; i++) {
            int status = await(all.boxes[i], alive);
            if (status)
                return status;
            end = end || all.boxes[i]->leaves;
            joined = joined && all.boxes[i]->joined;
        }
        if (now_ns > longest_ns)
            return ETIME;
        carry(now_ns);
        now_ns += joined ? QUANTUM_NS : LONG_QUANTUM_NS;
        for (int i = 0; i < all.guests; i++) {
            if (all.boxes[i]->full)
                return ENOBUFS;
            all.boxes[i]->next_ns = now_ns;
            all.boxes[i]->ended = end;
            let_go(all.boxes[i]);
        }
    }
    return 0;
}

/* Guests with mailboxes in these files are in lock-step, until one wishes to end. Radio N is guest `guest_of[N]`'s.
 * `alive`: asked each second in which a guest is waited for. `told`: what the channel did, as JSON. Returns 0, or a
 * number of errno.h: ETIMEDOUT where a guest has ended, ETIME where nobody wished to end by `longest_ns`, ENOBUFS where
 * a mailbox had no room, EINVAL where there are too many guests or radios. */
EXPORT int conduct(int guests, const char *const files[], int radios, const int guest_of[], double loss,
                   int64_t longest_ns, bool (*alive)(void), char *told, int size);

int conduct(int guests, const char *const files[], int radios, const int guest_of[], double loss, int64_t longest_ns,
            bool (*alive)(void), char *told, int size)
{
    if (guests < 1 || guests > GUESTS ||
        !channel_open(radios, loss, (struct fates){.deliver = deliver, .report = report}))
        return EINVAL;
    memcpy(all.guest_of, guest_of, (size_t)radios * sizeof *guest_of);
    int status = 0;
    for (all.guests = 0; all.guests < guests && !status; all.guests += !status) {
        int file = open(files[all.guests], O_RDWR | O_CLOEXEC);
        void *shared = mmap(NULL, MAILBOX_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
        status = shared == MAP_FAILED ? errno : 0;
        all.boxes[all.guests] = shared;
        close(file);
    }
    if (!status)
        status = quanta(longest_ns, alive);
    while (all.guests)
        munmap(all.boxes[--all.guests], MAILBOX_BYTES);
    tell(told, size);
    return status;
}
