#define _GNU_SOURCE
#include "socket.h"

#include <errno.h>
#include <linux/can/error.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

static int64_t ns_of(const struct timespec *time)
{
    return time->tv_sec * INT64_C(1000000000) + time->tv_nsec;
}

int can_open(struct fl_block *block, struct can_socket *can, const char *interface, const struct can_filter *filters,
             size_t count)
{
    const can_err_mask_t reports = CAN_ERR_BUSOFF | CAN_ERR_RESTARTED;
    const int on = 1;
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(interface)};
    if (!address.can_ifindex)
        return fl_fail(block, "there is no CAN interface %s: %s", interface, strerror(errno));
    can->fd = socket(AF_CAN, SOCK_RAW | SOCK_NONBLOCK | SOCK_CLOEXEC, CAN_RAW);
    if (can->fd < 0)
        return fl_fail(block, "CAN socket: %s", strerror(errno));
    if (setsockopt(can->fd, SOL_CAN_RAW, CAN_RAW_FILTER, filters, (socklen_t)(count * sizeof *filters)) < 0 ||
        setsockopt(can->fd, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, &reports, sizeof reports) < 0 ||
        setsockopt(can->fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on) < 0 ||
        bind(can->fd, (struct sockaddr *)&address, sizeof address) < 0)
        return fl_fail(block, "CAN interface %s: %s", interface, strerror(errno));
    return FL_OK;
}

/* The kernel stamps in CLOCK_REALTIME, which may be set at any time: only the frame's age is taken from it. */
static int64_t arrival(struct msghdr *message)
{
    enum { PLAUSIBLE_NS = 1000 * 1000 * 1000 };
    struct timespec stamp, real;
    int64_t now_ns = fl_now_ns(), age_ns = 0;
    clock_gettime(CLOCK_REALTIME, &real);
    for (struct cmsghdr *part = CMSG_FIRSTHDR(message); part; part = CMSG_NXTHDR(message, part)) {
        if (part->cmsg_level != SOL_SOCKET || part->cmsg_type != SCM_TIMESTAMPNS)
            continue;
        memcpy(&stamp, CMSG_DATA(part), sizeof stamp);
        age_ns = ns_of(&real) - ns_of(&stamp);
    }
    return age_ns > 0 && age_ns < PLAUSIBLE_NS ? now_ns - age_ns : now_ns;
}

static void take_report(struct can_socket *can, const struct can_frame *frame)
{
    if (frame->can_id & CAN_ERR_BUSOFF)
        can->bus_off = true;
    if (frame->can_id & CAN_ERR_RESTARTED)
        can->bus_off = false;
}

bool can_receive(struct can_socket *can, struct can_frame *frame, int64_t *arrived_ns)
{
    enum { REPORTS = 16 }; /* passed over in one call, so that it ends */
    for (int passed = 0; passed < REPORTS; passed++) {
        _Alignas(struct cmsghdr) char control[CMSG_SPACE(sizeof(struct timespec))];
        struct iovec data = {frame, sizeof *frame};
        struct msghdr message = {
            .msg_iov = &data, .msg_iovlen = 1, .msg_control = control, .msg_controllen = sizeof control};
        ssize_t count = recvmsg(can->fd, &message, MSG_DONTWAIT);
        if (count < 0)
            return false; /* none waits, or the interface is down */
        if ((size_t)count != sizeof *frame || frame->len > CAN_MAX_DLEN)
            continue;
        if (frame->can_id & CAN_ERR_FLAG) {
            take_report(can, frame);
            continue;
        }
        can->bus_off = false;
        *arrived_ns = arrival(&message);
        return true;
    }
    return false;
}

bool can_send(const struct can_socket *can, const struct can_frame *frame)
{
    return send(can->fd, frame, sizeof *frame, MSG_DONTWAIT) == (ssize_t)sizeof *frame;
}

void can_close(struct can_socket *can)
{
    if (can->fd > 0)
        close(can->fd);
    can->fd = 0;
}
