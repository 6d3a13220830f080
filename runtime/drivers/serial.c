/* Serial ports: settings, and the thread that turns bytes into stamped measurements. */
#define _GNU_SOURCE
#include <asm/termbits.h> /* termios2: any rate, not only POSIX's list; the C library's termios does not fit beside */
#include <errno.h>
#include <fcntl.h>
#include <flotilla/driver.h>
#include <stdatomic.h>
#include <string.h>
#include <sys/ioctl.h>
#include <unistd.h>

enum {
    RECORDS = 64,
    SENDABLE = 16,
    SEND_BYTES = 64,
    REOPEN_MS = 100,
    SILENCE_MS = 100,
    BATCH = 256,
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
    const struct fl_serial_protocol *protocol;
    struct fl_serial_settings settings;
    const void *parameters;
    struct fl_driver *driver;
    struct fl_ring arrivals, sendings;
    struct arrival *written, *taken; /* one record each for the two sides */
    void *parser;
    uint32_t sequence;
    _Atomic bool connected;
};

int fl_serial_open(const struct fl_serial_settings *settings)
{
    int fd = open(settings->device, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (fd < 0)
        return -1;
    static const unsigned sizes[] = {CS5, CS6, CS7, CS8};
    static const unsigned parities[] = {0, PARENB | PARODD, PARENB};
    struct termios2 raw = {.c_cc = {[VMIN] = 1}};
    raw.c_cflag = CREAD | CLOCAL | BOTHER | (BOTHER << IBSHIFT) | sizes[settings->data_bits - 5] |
                  parities[settings->parity] | (settings->stop_bits == 2 ? CSTOPB : 0);
    raw.c_iflag = IGNBRK | (settings->parity ? INPCK : 0);
    raw.c_ispeed = raw.c_ospeed = (speed_t)settings->baud;
    if (ioctl(fd, TIOCEXCL) < 0 || ioctl(fd, TCSETS2, &raw) < 0 || ioctl(fd, TCFLSH, TCIOFLUSH) < 0) {
        int error = errno;
        close(fd);
        errno = error;
        return -1;
    }
    return fd;
}

/* Send all of `bytes`; false when the thread shall return or the device is gone. */
static bool write_all(const struct fl_driver *driver, int fd, const uint8_t *bytes, size_t count)
{
    while (count) {
        ssize_t written = write(fd, bytes, count);
        if (written > 0) {
            bytes += written;
            count -= (size_t)written;
        } else if (written < 0 && errno != EAGAIN && errno != EINTR) {
            return false;
        } else if (fl_driver_wait(driver, fd, true, -1) < 0) {
            return false;
        }
    }
    return true;
}

static bool send_request(struct fl_serial *serial, const struct fl_driver *driver, int fd, int silent_ms)
{
    uint8_t out[SEND_BYTES];
    if (!serial->protocol->send)
        return true;
    return write_all(driver, fd, out,
                     serial->protocol->send(serial->parser, serial->parameters, silent_ms, out, sizeof out));
}

static bool send_queued(struct fl_serial *serial, const struct fl_driver *driver, int fd)
{
    struct sending queued;
    while (fl_ring_take(&serial->sendings, &queued))
        if (!write_all(driver, fd, queued.bytes, queued.count))
            return false;
    return true;
}

static void feed(struct fl_serial *serial, const uint8_t *bytes, size_t count)
{
    serial->written->at_ns = fl_now_ns();
    for (size_t at = 0; at < count; at++) {
        if (serial->protocol->feed(serial->parser, bytes[at], serial->written->sample)) {
            serial->written->sequence = ++serial->sequence;
            fl_ring_put(&serial->arrivals, serial->written);
        }
    }
}

/* Talk to an open port until it is gone or the thread shall return. */
static void converse(struct fl_serial *serial, const struct fl_driver *driver, int fd)
{
    int silent_ms = 0;
    memset(serial->parser, 0, serial->protocol->parser_size);
    if (!send_request(serial, driver, fd, -1))
        return;
    for (;;) {
        uint8_t bytes[BATCH];
        int ready = fl_driver_wait(driver, fd, false, SILENCE_MS);
        if (ready < 0)
            return;
        if (ready == 0) {
            silent_ms += SILENCE_MS;
        } else {
            ssize_t count = read(fd, bytes, sizeof bytes);
            if (count == 0 || (count < 0 && errno != EAGAIN && errno != EINTR))
                return;
            if (count > 0)
                feed(serial, bytes, (size_t)count);
            silent_ms = 0;
        }
        if (!send_request(serial, driver, fd, silent_ms) || !send_queued(serial, driver, fd))
            return;
    }
}

static void run(struct fl_driver *driver, void *context)
{
    struct fl_serial *serial = context;
    do {
        int fd = fl_serial_open(&serial->settings);
        if (fd < 0)
            continue;
        atomic_store(&serial->connected, true);
        converse(serial, driver, fd);
        atomic_store(&serial->connected, false);
        close(fd);
    } while (fl_driver_wait(driver, -1, false, REOPEN_MS) == 0);
}

struct fl_serial *fl_serial_start(struct fl_block *block, const struct fl_serial_protocol *protocol,
                                  struct fl_serial_settings settings, const void *parameters)
{
    size_t record = (sizeof(struct arrival) + protocol->sample_size + 7) & ~(size_t)7;
    struct fl_serial *serial = fl_allocate(block, sizeof *serial);
    void *arrivals = fl_allocate(block, fl_ring_bytes(record, RECORDS));
    void *sendings = fl_allocate(block, fl_ring_bytes(sizeof(struct sending), SENDABLE));
    if (!serial || !arrivals || !sendings)
        return NULL;
    serial->protocol = protocol;
    serial->settings = settings;
    serial->parameters = parameters;
    serial->parser = fl_allocate(block, protocol->parser_size);
    serial->written = fl_allocate(block, record);
    serial->taken = fl_allocate(block, record);
    if (!serial->parser || !serial->written || !serial->taken)
        return NULL;
    fl_ring_initialize(&serial->arrivals, arrivals, record, RECORDS);
    fl_ring_initialize(&serial->sendings, sendings, sizeof(struct sending), SENDABLE);
    serial->driver = fl_driver_start(block, run, serial);
    return serial->driver ? serial : NULL;
}

bool fl_serial_next(struct fl_serial *serial, void *sample, int64_t *arrived_ns, uint32_t *sequence)
{
    if (!fl_ring_take(&serial->arrivals, serial->taken))
        return false;
    memcpy(sample, serial->taken->sample, serial->protocol->sample_size);
    *arrived_ns = serial->taken->at_ns;
    *sequence = serial->taken->sequence;
    return true;
}

bool fl_serial_newest(struct fl_serial *serial, void *sample, int64_t *arrived_ns, uint32_t *sequence)
{
    bool any = false;
    /* Bounded: the thread may put while this takes, but a step must end. */
    for (int taken = 0; taken < RECORDS && fl_serial_next(serial, sample, arrived_ns, sequence); taken++)
        any = true;
    return any;
}

bool fl_serial_connected(const struct fl_serial *serial)
{
    return atomic_load(&serial->connected);
}

bool fl_serial_send(struct fl_serial *serial, const uint8_t *bytes, size_t count)
{
    struct sending queued = {.count = (uint32_t)count};
    if (count > sizeof queued.bytes)
        return false;
    memcpy(queued.bytes, bytes, count);
    return fl_ring_put(&serial->sendings, &queued);
}

void fl_serial_stop(struct fl_serial *serial)
{
    if (serial)
        fl_driver_stop(serial->driver);
}
