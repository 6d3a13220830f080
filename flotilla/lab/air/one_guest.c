/* The air between simulated radios of one computer: frames take their time on one channel. */
#define _GNU_SOURCE
#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#include "hwsim.h"

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

static void deliver(const struct frame *frame, int receiver, unsigned rate, int64_t at_ns)
{
    (void)at_ns; /* it is that time */
    /* Radio N of the module has the address 42:00:00:00:NN:00, and its interface 02:00:00:00:NN:00. */
    const uint8_t address[ADDRESS] = {0x42, 0, 0, (uint8_t)(receiver >> 8), (uint8_t)receiver, 0};
    hwsim_deliver(frame, address, rate);
}

static void report(struct frame *frame, int sender, bool acknowledged, int64_t at_ns)
{
    (void)sender; /* the frame has its address */
    (void)at_ns;
    hwsim_report(frame, acknowledged);
}

static void take(struct frame *frame)
{
    int sender = channel_radio(frame->transmitter);
    if (sender < 0)
        free(frame);
    else
        channel_take(sender, frame, now_ns());
}

/* Carry frames between the first `radios` of the module until SIGTERM. 0 to 1 of the attempts get lost. Returns 0, or a
 * number of errno.h where the driver does not give them over; `ready` is written to once it does. */
EXPORT int carry(int radios, double loss, int ready);

int carry(int radios, double loss, int ready)
{
    if (!channel_open(radios, loss, (struct fates){.deliver = deliver, .report = report}))
        return EINVAL;
    int status = hwsim_open();
    if (status)
        return status;
    sigset_t term, usual;
    sigemptyset(&term);
    sigaddset(&term, SIGTERM);
    sigprocmask(SIG_BLOCK, &term, &usual);
    sigdelset(&usual, SIGTERM);
    sigaction(SIGTERM, &(struct sigaction){.sa_handler = end_it}, NULL);
    if ((status = hwsim_register()))
        return status;
    if (write(ready, "\n", 1) < 0)
        return errno;
    while (!ended) {
        int64_t due = channel_next_ns(), wait = due < 0 ? -1 : due - now_ns();
        if (due >= 0 && wait <= 0) {
            channel_happen(now_ns());
            continue;
        }
        struct timespec pause = {.tv_sec = wait / 1000000000, .tv_nsec = wait % 1000000000};
        struct pollfd waits = {.fd = hwsim_socket(), .events = POLLIN};
        if (ppoll(&waits, 1, due < 0 ? NULL : &pause, &usual) < 0 && errno != EINTR)
            return errno;
        hwsim_read(take);
    }
    return 0;
}
