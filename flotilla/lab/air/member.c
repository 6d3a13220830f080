/* A guest's part in lock-step: what its radios send goes to the conductor, and they hear what comes from there.
 *
 * Runs in the guest, above all else while in lock-step: it is no computer's. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <sched.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>
#include <x86intrin.h>

#include "hwsim.h"
#include "lockstep.h"

enum { PRIORITY = 98 };

static struct mailbox *mailbox;

static volatile sig_atomic_t ended;

static void end_it(int number)
{
    ended = number;
}

/* In QEMU with `-icount` the counter counts nanoseconds of virtual time. */
static int64_t now_ns(void)
{
    return (int64_t)__rdtsc();
}

static void take(struct frame *frame)
{
    struct message *message = room(&mailbox->out);
    if (message) {
        message->at_ns = now_ns();
        message->kind = SENT;
        message->radio = (uint32_t)radio_number(frame->transmitter);
        memcpy(&message->frame, frame, frame_bytes(frame));
        mailbox->out.head++;
    } else {
        mailbox->full++;
    }
    free(frame);
}

static void address_of(uint32_t radio, uint8_t address[ADDRESS])
{
    const uint8_t made[ADDRESS] = {0x02, 0, 0, (uint8_t)(radio >> 8), (uint8_t)radio, 0};
    memcpy(address, made, ADDRESS);
}

static void hand_over(const struct message *message)
{
    uint8_t address[ADDRESS];
    address_of(message->radio, address);
    if (message->kind == HEARD)
        hwsim_deliver(&message->frame, address, message->rate);
    else
        hwsim_report(&message->frame, message->acknowledged);
}

/* Wait for frames of this guest's radios, for the bell, and for the time of what they hear. */
static int await(int bell, const sigset_t *usual)
{
    const struct message *next = first(&mailbox->in);
    int64_t wait = next ? next->at_ns - now_ns() : 0;
    struct timespec pause = {.tv_sec = wait / 1000000000, .tv_nsec = wait % 1000000000};
    struct pollfd waits[] = {{.fd = hwsim_socket(), .events = POLLIN}, {.fd = bell, .events = POLLIN}};
    if (next && wait <= 0)
        return 0;
    if (ppoll(waits, 2, next ? &pause : NULL, usual) < 0 && errno != EINTR)
        return errno;
    char rung[16];
    if (waits[1].revents && read(bell, rung, sizeof rung) < 0 && errno != EAGAIN)
        return errno;
    return 0;
}

/* Make `count` radios, `number` and those after it, and be in lock-step until all end, which SIGTERM wishes for.
 * `memory`: the mailbox. `line`: a terminal in raw mode, from which bytes come when there is mail. Returns 0 or a
 * number of errno.h; `ready` is written to at the beginning. */
EXPORT int take_part(const char *memory, const char *line, int number, int count, int ready);

int take_part(const char *memory, const char *line, int number, int count, int ready)
{
    int file = open(memory, O_RDWR | O_CLOEXEC), bell = open(line, O_RDONLY | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (file < 0 || bell < 0)
        return errno;
    void *shared = mmap(NULL, MAILBOX_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    if (shared == MAP_FAILED)
        return errno;
    mailbox = shared;
    int status = hwsim_open();
    for (int i = 0; i < count && !status; i++) {
        uint8_t address[ADDRESS];
        address_of((uint32_t)(number + i), address);
        status = hwsim_new_radio(address);
    }
    sigset_t term, usual;
    sigemptyset(&term);
    sigaddset(&term, SIGTERM);
    sigprocmask(SIG_BLOCK, &term, &usual);
    sigdelset(&usual, SIGTERM);
    sigaction(SIGTERM, &(struct sigaction){.sa_handler = end_it}, NULL);
    if (!status)
        status = hwsim_register();
    if (status)
        return status;
    const struct sched_param above = {.sched_priority = PRIORITY}, ordinary = {.sched_priority = 0};
    if (sched_setscheduler(0, SCHED_FIFO, &above) < 0)
        return errno;
    mailbox->joined = 1;
    if (write(ready, "\n", 1) < 0)
        return errno;
    while (!mailbox->ended) {
        hwsim_read(take);
        for (const struct message *next; (next = first(&mailbox->in)) && next->at_ns <= now_ns(); mailbox->in.tail++)
            hand_over(next);
        mailbox->leaves = !!ended;
        if ((status = await(bell, &usual)))
            return status;
    }
    return sched_setscheduler(0, SCHED_OTHER, &ordinary) < 0 ? errno : 0;
}
