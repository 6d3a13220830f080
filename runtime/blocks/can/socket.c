#define _GNU_SOURCE
#include "socket.h"

#include "core/wall_clock.h"

#include <errno.h>
#include <linux/can/error.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { LOOK_MS = 100 };

/* What the interface is, as the journal has it; a number above these is errno of what failed. */
enum { UP = -5, BUS_OFF, DOWN, NO_CAN, MISSING, UNKNOWN };

static int64_t ns_of(const struct timespec *time)
{
    return time->tv_sec * INT64_C(1000000000) + time->tv_nsec;
}

/* --- the thread --- */

static int open_socket(struct can_socket *can)
{
    const can_err_mask_t reports = CAN_ERR_BUSOFF | CAN_ERR_RESTARTED;
    const int on = 1;
    int fd = socket(AF_CAN, SOCK_RAW | SOCK_NONBLOCK | SOCK_CLOEXEC, CAN_RAW);
    if (fd < 0)
        return errno;
    if (setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FILTER, can->filters,
                   (socklen_t)(can->filter_count * sizeof *can->filters)) < 0 ||
        setsockopt(fd, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, &reports, sizeof reports) < 0 ||
        setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on) < 0 || !socket_bound_queue(fd)) {
        int error = errno;
        close(fd);
        return error;
    }
    atomic_store(&can->fd, fd);
    return 0;
}

/* An interface that was removed and is there again has another index. The kernel lets a socket be bound anew. */
static int bind_to(struct can_socket *can, unsigned index)
{
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)index};
    if (index == can->bound)
        return 0;
    atomic_store(&can->up, false);
    can->bound = 0;
    if (bind(atomic_load(&can->fd), (struct sockaddr *)&address, sizeof address) < 0)
        return errno;
    can->bound = index;
    return 0;
}

/* Bind the socket where that can be done now; what there is of the interface. */
static int look(struct can_socket *can)
{
    struct ifreq request = {0};
    int error = atomic_load(&can->fd) ? 0 : open_socket(can);
    if (error)
        return error;
    unsigned index = if_nametoindex(can->interface);
    if (!index)
        return MISSING;
    error = bind_to(can, index);
    if (error)
        return error == ENODEV ? NO_CAN : error; /* of another kind, as its index says it is there */
    strncpy(request.ifr_name, can->interface, sizeof request.ifr_name - 1);
    if (ioctl(atomic_load(&can->fd), SIOCGIFFLAGS, &request) < 0)
        return MISSING; /* removed just now */
    if (!(request.ifr_flags & IFF_UP))
        return DOWN;
    return atomic_load(&can->bus_off) || !(request.ifr_flags & IFF_RUNNING) ? BUS_OFF : UP;
}

/* Say each state once, not ten times a second. */
static void log_state(struct can_socket *can, int state)
{
    const char *interface = can->interface;
    if (state == can->logged)
        return;
    can->logged = state;
    switch (state) {
    case UP:
        fl_log(can->block, "CAN interface %s is up", interface);
        break;
    case BUS_OFF:
        fl_warn(can->block,
                "CAN interface %s is bus-off: check cable, termination and bit rate; whether it tries again by itself "
                "is said under `can:` in the inventory",
                interface);
        break;
    case DOWN:
        fl_warn(can->block, "CAN interface %s is down: name it under `can:` in the inventory, with the bus's bit rate",
                interface);
        break;
    case NO_CAN:
        fl_warn(can->block, "%s is not a CAN interface: set the parameter `interface`", interface);
        break;
    case MISSING:
        fl_warn(can->block,
                "there is no CAN interface %s: plug it in, and name it under `can:` in the inventory; waiting for it",
                interface);
        break;
    case EAFNOSUPPORT:
    case EPROTONOSUPPORT:
        fl_warn(can->block, "CAN interface %s: the kernel has no CAN: load the modules can and can-raw; retrying",
                interface);
        break;
    default:
        fl_warn(can->block, "CAN interface %s: %s; retrying", interface, strerror(state));
        break;
    }
}

static void update(struct can_socket *can)
{
    if (!atomic_load(&can->up)) {
        atomic_store(&can->bus_off, false); /* an interface that comes up begins anew */
        if (can->logged <= BUS_OFF)
            can->logged = UNKNOWN; /* log the interruption, however short */
    }
    int state = look(can);
    bool up = state == UP || state == BUS_OFF;
    log_state(can, state);
    if (up && !atomic_load(&can->up))
        atomic_fetch_add(&can->connections, 1);
    atomic_store(&can->up, up);
}

static void run(struct fl_driver *driver, void *context)
{
    struct can_socket *can = context;
    int woken;
    while ((woken = fl_driver_wait(driver, can->end_fd ? can->end_fd : -1, false, LOOK_MS)) == 0) {
        update(can);
        if (can->watch)
            can->watch(can->block);
    }
    if (woken == 1)
        can->end(can->block);
}

int can_start(struct fl_block *block, struct can_socket *can, const char *interface, const struct can_filter *filters,
              size_t count)
{
    can->block = block;
    can->interface = interface;
    if (count > CAN_FILTERS)
        return fl_fail(block, "%zu CAN filters", count);
    if (count)
        memcpy(can->filters, filters, count * sizeof *filters);
    can->filter_count = count;
    can->logged = UNKNOWN;
    if (can->end && (can->end_fd = eventfd(0, EFD_CLOEXEC)) < 0) {
        can->end_fd = 0;
        return fl_fail(block, "eventfd: %s", strerror(errno));
    }
    update(can); /* one that is there is used from the first step on */
    /* It is in no hurry, and at a priority of its task's it would hold up every task of less. */
    can->driver = fl_driver_start_ordinary(block, run, can);
    return can->driver ? FL_OK : FL_FAILED;
}

void can_end(const struct can_socket *can)
{
    if (can->end_fd)
        eventfd_write(can->end_fd, 1);
}

void can_join(struct can_socket *can)
{
    fl_driver_stop(can->driver);
    can->driver = NULL;
}

void can_stop(struct can_socket *can)
{
    can_join(can);
    int fd = atomic_exchange(&can->fd, 0);
    if (fd)
        close(fd);
    if (can->end_fd)
        close(can->end_fd);
    can->end_fd = 0;
}

/* --- the step --- */

bool can_connected(const struct can_socket *can)
{
    return atomic_load(&can->up);
}

/* A step notices first that an interface was removed; the thread would miss it if it is back before its next look. */
static void judge(struct can_socket *can, int error)
{
    if (error == ENETDOWN || error == ENODEV || error == ENXIO)
        atomic_store(&can->up, false);
}

/* The kernel stamps in CLOCK_REALTIME, which may be set at any time: only the frame's age is taken from it. */
static int64_t arrival(struct msghdr *message)
{
    enum { PLAUSIBLE_NS = 1000 * 1000 * 1000 };
    struct timespec stamp;
    int64_t now_ns = fl_now_ns(), wall_ns = now_ns + fl_wall_less_monotonic_ns(), age_ns = 0;
    for (struct cmsghdr *part = CMSG_FIRSTHDR(message); part; part = CMSG_NXTHDR(message, part)) {
        if (part->cmsg_level != SOL_SOCKET || part->cmsg_type != SCM_TIMESTAMPNS)
            continue;
        memcpy(&stamp, CMSG_DATA(part), sizeof stamp);
        age_ns = wall_ns - ns_of(&stamp);
    }
    return age_ns > 0 && age_ns < PLAUSIBLE_NS ? now_ns - age_ns : now_ns;
}

static void take_report(struct can_socket *can, const struct can_frame *frame)
{
    if (frame->can_id & CAN_ERR_BUSOFF)
        atomic_store(&can->bus_off, true);
    if (frame->can_id & CAN_ERR_RESTARTED)
        atomic_store(&can->bus_off, false);
}

bool can_receive(struct can_socket *can, struct can_frame *frame, int64_t *arrived_ns)
{
    enum { REPORTS = 16 }; /* passed over in one call, so that it ends */
    int fd = atomic_load(&can->fd);
    if (!fd)
        return false;
    for (int passed = 0; passed < REPORTS; passed++) {
        _Alignas(struct cmsghdr) char control[CMSG_SPACE(sizeof(struct timespec))];
        struct iovec data = {frame, sizeof *frame};
        struct msghdr message = {
            .msg_iov = &data, .msg_iovlen = 1, .msg_control = control, .msg_controllen = sizeof control};
        ssize_t count = recvmsg(fd, &message, MSG_DONTWAIT);
        if (count < 0) {
            judge(can, errno);
            return false;
        }
        if ((size_t)count != sizeof *frame || frame->len > CAN_MAX_DLEN)
            continue;
        if (frame->can_id & CAN_ERR_FLAG) {
            take_report(can, frame);
            continue;
        }
        atomic_store(&can->bus_off, false);
        *arrived_ns = arrival(&message);
        return true;
    }
    return false;
}

bool can_send(struct can_socket *can, const struct can_frame *frame)
{
    int fd = atomic_load(&can->fd);
    if (!fd)
        return false;
    if (send(fd, frame, sizeof *frame, MSG_DONTWAIT) == (ssize_t)sizeof *frame)
        return true;
    judge(can, errno);
    return false;
}
