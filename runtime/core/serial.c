/* Serial ports: settings, and the thread that turns bytes into stamped measurements. */
#define _GNU_SOURCE
#include "newest.h"
#include "service.h"

#include <asm/termbits.h> /* termios2 allows any rate, not only those of POSIX; it conflicts with termios.h of the C library */
#include <errno.h>
#include <fcntl.h>
#include <flotilla/driver.h>
#include <inttypes.h>
#include <limits.h>
#include <linux/serial.h>
#include <poll.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/ioctl.h>
#include <unistd.h>

#define PATIENCE_NS (INT64_C(1000000000) * FL_SERIAL_PATIENCE_S)

enum {
    SENDABLE = 16,
    SEND_BYTES = 64,
    REOPEN_MS = 100,
    SILENCE_MS = 100,
    STUCK_MS = 1000,  /* a port that accepts no bytes for this long is opened again */
    CLOSING_MS = 500, /* for sending the rest when the thread has to return */
    BATCH = 256,
    COUNTING_MS = 1000,  /* between two looks at what the port has lost */
    RATE_TOLERANCE = 50, /* 1/50: two UARTs may differ by some 4 % over a character; this is half of it */
};

struct arrival {
    int64_t at_ns;
    uint32_t sequence;
    _Alignas(8) unsigned char sample[];
};

struct sending {
    uint32_t count;
    uint8_t bytes[SEND_BYTES];
};

struct fl_serial {
    struct fl_block *block;
    const struct fl_serial_protocol *protocol;
    struct fl_serial_settings settings;
    const void *parameters;
    struct fl_driver *driver;
    struct fl_ring arrivals, sendings;
    struct newest newest; /* of struct arrival */
    struct arrival *taken;
    void *parser;
    int64_t baud;        /* that the port is set to */
    int64_t close_by_ns; /* 0: the thread need not return yet */
    uint32_t sequence;
    int open_error; /* the last error that was logged */
    struct fl_reasons reasons;
    int64_t judged_ns;  /* when the last measurement or reason came */
    bool received;      /* bytes came since then */
    int64_t counted_ns; /* when the port was last asked what it has lost */
    struct serial_icounter_struct counts;
    _Atomic bool connected;
};

/* A lock rather than TIOCEXCL, which outlives a killed process while another one keeps the port open, as robots do for
 * the interrupt thread of the port. */
static int lock_port(int fd)
{
    if (flock(fd, LOCK_EX | LOCK_NB) == 0)
        return 0;
    if (errno == EWOULDBLOCK)
        errno = EBUSY;
    return -1;
}

/* 0, or an errno. */
static int set_port(int fd, const struct fl_serial_settings *settings)
{
    static const unsigned sizes[] = {CS5, CS6, CS7, CS8};
    static const unsigned parities[] = {0, PARENB | PARODD, PARENB};
    struct termios2 raw = {.c_cc = {[VMIN] = 1}};
    raw.c_cflag = CREAD | CLOCAL | BOTHER | (BOTHER << IBSHIFT) | sizes[settings->data_bits - 5] |
                  parities[settings->parity] | (settings->stop_bits == 2 ? CSTOPB : 0);
    raw.c_iflag = IGNBRK | (settings->parity ? INPCK : 0);
    raw.c_ispeed = raw.c_ospeed = (speed_t)settings->baud;
    struct termios2 set;
    if (ioctl(fd, TCSETS2, &raw) < 0 || ioctl(fd, TCGETS2, &set) < 0)
        return errno;
    /* A driver may silently choose the nearest rate it has, or keep the previous one. */
    return llabs((long long)set.c_ospeed - settings->baud) > settings->baud / RATE_TOLERANCE ? ERANGE : 0;
}

int fl_serial_open(const struct fl_serial_settings *settings)
{
    int fd = open(settings->device, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (fd < 0)
        return -1;
    int error = lock_port(fd) < 0 ? errno : set_port(fd, settings);
    if (!error && ioctl(fd, TCFLSH, TCIOFLUSH) < 0)
        error = errno;
    if (error) {
        close(fd);
        errno = error;
        return -1;
    }
    return fd;
}

static int left_ms(int64_t until_ns)
{
    int64_t left_ns = until_ns - fl_now_ns();
    return left_ns > 0 ? (int)(left_ns / 1000000) + 1 : 0;
}

/* Set the time by which the thread returns in any case. */
static void begin_closing(struct fl_serial *serial)
{
    if (!serial->close_by_ns)
        serial->close_by_ns = fl_now_ns() + CLOSING_MS * INT64_C(1000000);
}

/* 1 writable, 0 time-out, -2 the device is gone. */
static int wait_writable(struct fl_serial *serial, const struct fl_driver *driver, int fd, int64_t until_ns)
{
    if (!serial->close_by_ns) {
        int ready = fl_driver_wait(driver, fd, true, left_ms(until_ns));
        if (ready != -1)
            return ready;
        begin_closing(serial);
    }
    struct pollfd waiting = {.fd = fd, .events = POLLOUT};
    if (poll(&waiting, 1, left_ms(until_ns < serial->close_by_ns ? until_ns : serial->close_by_ns)) < 1)
        return 0;
    return waiting.revents & POLLOUT ? 1 : -2;
}

/* Send all of `bytes`, even when the thread has to return meanwhile: half a command would corrupt the last one, which
 * makes the device safe. 0, or an errno: ETIMEDOUT where the port accepts nothing, EIO where the device is gone. */
static int write_all(struct fl_serial *serial, const struct fl_driver *driver, int fd, const uint8_t *bytes,
                     size_t count)
{
    int64_t until_ns = fl_now_ns() + STUCK_MS * INT64_C(1000000);
    while (count) {
        ssize_t written = write(fd, bytes, count);
        if (written > 0) {
            bytes += written;
            count -= (size_t)written;
            continue;
        }
        if (written < 0 && errno != EAGAIN && errno != EINTR)
            return errno;
        int ready = wait_writable(serial, driver, fd, until_ns);
        if (ready < 1)
            return ready ? EIO : ETIMEDOUT;
    }
    return 0;
}

/* No device answers at a rate that the port cannot do, which the protocol notices. */
static void change_baud(struct fl_serial *serial, int fd, int64_t baud)
{
    struct fl_serial_settings settings = serial->settings;
    if (baud)
        settings.baud = baud;
    if (settings.baud == serial->baud)
        return;
    serial->baud = settings.baud;
    set_port(fd, &settings);
    ioctl(fd, TCFLSH, TCIFLUSH); /* what came at the other rate */
}

static int send_request(struct fl_serial *serial, const struct fl_driver *driver, int fd, int silent_ms)
{
    uint8_t out[SEND_BYTES];
    if (!serial->protocol->send)
        return 0;
    size_t count = serial->protocol->send(serial->parser, serial->parameters, silent_ms, out, sizeof out);
    if (serial->protocol->baud)
        change_baud(serial, fd, serial->protocol->baud(serial->parser));
    return write_all(serial, driver, fd, out, count);
}

static int send_queued(struct fl_serial *serial, const struct fl_driver *driver, int fd)
{
    struct sending queued;
    int error = 0;
    while (!error && fl_ring_take(&serial->sendings, &queued))
        error = write_all(serial, driver, fd, queued.bytes, queued.count);
    return error;
}

static void forget_queued(struct fl_serial *serial)
{
    struct sending queued;
    while (fl_ring_take(&serial->sendings, &queued))
        ;
}

/* The number of measurements that the bytes completed. */
static unsigned feed(struct fl_serial *serial, const uint8_t *bytes, size_t count)
{
    int64_t now_ns = fl_now_ns();
    unsigned measurements = 0;
    for (size_t at = 0; at < count; at++) {
        struct arrival *arrival = newest_back(&serial->newest);
        if (!serial->protocol->feed(serial->parser, bytes[at], arrival->sample))
            continue;
        measurements++;
        arrival->at_ns = now_ns;
        arrival->sequence = ++serial->sequence;
        if (serial->protocol->records)
            fl_ring_put(&serial->arrivals, arrival);
        else
            newest_put(&serial->newest);
    }
    return measurements;
}

/* Log what is wrong with the received bytes, or that too few came. */
static void judge(struct fl_serial *serial, size_t bytes, unsigned measurements)
{
    const struct fl_serial_settings *settings = &serial->settings;
    int64_t now_ns = fl_now_ns();
    const char *reason = serial->protocol->reason ? serial->protocol->reason(serial->parser, serial->parameters) : NULL;
    serial->received = serial->received || bytes;
    if (reason || measurements) {
        if (reason)
            fl_reasons_log(&serial->reasons, serial->block, now_ns, "%s: %s", settings->device, reason);
        else
            fl_reasons_good(&serial->reasons, now_ns);
        serial->judged_ns = now_ns;
        serial->received = false;
    } else if (now_ns - serial->judged_ns > PATIENCE_NS) {
        fl_reasons_log(&serial->reasons, serial->block, now_ns,
                       "%s: %s came for %d s: check the device's %s, and its rate, %" PRId64 " Bd", settings->device,
                       serial->received ? "bytes but no measurement" : "nothing", FL_SERIAL_PATIENCE_S,
                       serial->received ? "type" : "power, its cable", settings->baud);
    }
}

/* Count, and log, bytes that were lost before they could be read. Ports that count none, such as pseudo terminals, have
 * lost none. */
static void count_lost(struct fl_serial *serial, int fd)
{
    static const char cause[] = "a thread of higher priority runs for too long, or interrupts are off";
    const struct serial_icounter_struct before = serial->counts;
    const int64_t now_ns = fl_now_ns();
    if (now_ns - serial->counted_ns < COUNTING_MS * INT64_C(1000000))
        return;
    serial->counted_ns = now_ns;
    if (ioctl(fd, TIOCGICOUNT, &serial->counts) < 0)
        return;
    const uint32_t overruns = (uint32_t)serial->counts.overrun - (uint32_t)before.overrun;
    const uint32_t full = (uint32_t)serial->counts.buf_overrun - (uint32_t)before.buf_overrun;
    atomic_fetch_add_explicit(&serial->block->service->lost, overruns + full, memory_order_relaxed);
    if (overruns)
        fl_reasons_log(&serial->reasons, serial->block, now_ns,
                       "%s: bytes were lost in the UART (overrun), because its interrupt was served too late: %s",
                       serial->settings.device, cause);
    if (full)
        fl_reasons_log(&serial->reasons, serial->block, now_ns,
                       "%s: bytes were lost in the kernel's buffer (overrun), which was read too late: %s",
                       serial->settings.device, cause);
}

/* Serve an open port until the thread has to return (0), or the device is gone or stuck (an errno). */
static int converse(struct fl_serial *serial, const struct fl_driver *driver, int fd)
{
    int64_t received_ns = fl_now_ns();
    memset(serial->parser, 0, serial->protocol->parser_size);
    serial->judged_ns = received_ns;
    serial->received = false;
    serial->counted_ns = received_ns;
    if (ioctl(fd, TIOCGICOUNT, &serial->counts) < 0)
        memset(&serial->counts, 0, sizeof serial->counts);
    int error = send_request(serial, driver, fd, FL_SERIAL_OPENED);
    while (!error) {
        uint8_t bytes[BATCH];
        ssize_t count = 0;
        unsigned measurements = 0;
        int ready = fl_driver_wait(driver, fd, false, SILENCE_MS);
        if (ready < 0)
            return ready == -2 ? EIO : 0;
        if (ready > 0) {
            count = read(fd, bytes, sizeof bytes);
            if (count == 0 || (count < 0 && errno != EAGAIN && errno != EINTR))
                return EIO;
            if (count > 0)
                measurements = feed(serial, bytes, (size_t)count);
            received_ns = fl_now_ns();
        }
        judge(serial, count > 0 ? (size_t)count : 0, measurements);
        count_lost(serial, fd);
        int64_t silent_ms = ready > 0 ? 0 : (fl_now_ns() - received_ns) / 1000000;
        error = send_request(serial, driver, fd, silent_ms < INT_MAX ? (int)silent_ms : INT_MAX);
        if (!error)
            error = send_queued(serial, driver, fd);
    }
    return error;
}

/* Send the queued bytes and the final command of the protocol, and wait until they are on the wire. close() would wait
 * for up to half a minute. */
static int end(struct fl_serial *serial, const struct fl_driver *driver, int fd)
{
    begin_closing(serial);
    int error = send_queued(serial, driver, fd);
    if (!error)
        error = send_request(serial, driver, fd, FL_SERIAL_CLOSING);
    int waiting = 0;
    while (!error && ioctl(fd, TIOCOUTQ, &waiting) == 0 && waiting)
        if (left_ms(serial->close_by_ns))
            poll(NULL, 0, 1);
        else
            error = ETIMEDOUT;
    return error;
}

/* Log once why a port cannot be opened, not ten times a second. */
static void log_open(struct fl_serial *serial, int error)
{
    if (error == serial->open_error)
        return;
    serial->open_error = error;
    if (error == ERANGE)
        fl_warn(serial->block, "%s cannot do %" PRId64 " Bd", serial->settings.device, serial->settings.baud);
    else if (error)
        fl_warn(serial->block, "cannot open %s: %s; retrying", serial->settings.device, strerror(error));
    else
        fl_log(serial->block, "%s is open", serial->settings.device);
}

static void run(struct fl_driver *driver, void *context)
{
    struct fl_serial *serial = context;
    do {
        int fd = fl_serial_open(&serial->settings);
        log_open(serial, fd < 0 ? errno : 0);
        if (fd < 0)
            continue;
        forget_queued(serial);
        atomic_store(&serial->connected, true);
        serial->baud = serial->settings.baud;
        int error = converse(serial, driver, fd);
        atomic_store(&serial->connected, false);
        if (!error)
            error = end(serial, driver, fd);
        if (error) {
            /* Otherwise close() would wait for bytes that can no longer be sent. */
            ioctl(fd, TCFLSH, TCIOFLUSH);
            fl_warn(serial->block, "%s %s", serial->settings.device,
                    error == ETIMEDOUT ? "accepts no more bytes: closed" : "is gone");
        }
        close(fd);
    } while (fl_driver_wait(driver, -1, false, REOPEN_MS) == 0);
}

struct fl_serial *fl_serial_start(struct fl_block *block, const struct fl_serial_protocol *protocol,
                                  struct fl_serial_settings settings, const void *parameters)
{
    size_t record = (sizeof(struct arrival) + protocol->sample_size + 7) & ~(size_t)7;
    struct fl_serial *serial = fl_allocate(block, sizeof *serial);
    void *arrivals = fl_allocate(block, fl_ring_bytes(record, protocol->records));
    void *sendings = fl_allocate(block, fl_ring_bytes(sizeof(struct sending), SENDABLE));
    if (!serial || !arrivals || !sendings)
        return NULL;
    serial->block = block;
    serial->protocol = protocol;
    serial->settings = settings;
    serial->parameters = parameters;
    serial->parser = fl_allocate(block, protocol->parser_size);
    serial->taken = fl_allocate(block, record);
    if (!serial->parser || !serial->taken || newest_allocate(&serial->newest, block, record) != FL_OK)
        return NULL;
    fl_ring_initialize(&serial->arrivals, arrivals, record, protocol->records);
    fl_ring_initialize(&serial->sendings, sendings, sizeof(struct sending), SENDABLE);
    serial->driver = fl_driver_start(block, run, serial);
    return serial->driver ? serial : NULL;
}

static void hand_over(const struct fl_serial *serial, const struct arrival *arrival, void *sample, int64_t *arrived_ns,
                      uint32_t *sequence)
{
    memcpy(sample, arrival->sample, serial->protocol->sample_size);
    *arrived_ns = arrival->at_ns;
    *sequence = arrival->sequence;
}

bool fl_serial_next(struct fl_serial *serial, void *sample, int64_t *arrived_ns, uint32_t *sequence)
{
    if (!serial->protocol->records || !fl_ring_take(&serial->arrivals, serial->taken))
        return false;
    hand_over(serial, serial->taken, sample, arrived_ns, sequence);
    return true;
}

bool fl_serial_newest(struct fl_serial *serial, void *sample, int64_t *arrived_ns, uint32_t *sequence)
{
    bool any = false;
    /* Bounded: the thread may add records meanwhile, but a step must end. */
    for (uint32_t taken = 0; taken < serial->protocol->records; taken++) {
        if (!fl_serial_next(serial, sample, arrived_ns, sequence))
            break;
        any = true;
    }
    if (serial->protocol->records)
        return any;
    const struct arrival *arrival = newest_take(&serial->newest);
    if (arrival)
        hand_over(serial, arrival, sample, arrived_ns, sequence);
    return arrival;
}

bool fl_serial_connected(const struct fl_serial *serial)
{
    return atomic_load(&serial->connected);
}

bool fl_serial_send(struct fl_serial *serial, const uint8_t *bytes, size_t count)
{
    struct sending queued = {.count = (uint32_t)count};
    if (count > sizeof queued.bytes || !fl_serial_connected(serial))
        return false;
    memcpy(queued.bytes, bytes, count);
    return fl_ring_put(&serial->sendings, &queued);
}

void fl_serial_stop(struct fl_serial *serial)
{
    if (serial)
        fl_driver_stop(serial->driver);
}
