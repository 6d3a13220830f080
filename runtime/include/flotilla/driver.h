/* What a block that drives a device needs: a thread of its own for the I/O, and the serial port.
 *
 * The thread may block; the block's step never does. What arrives is stamped by the thread (CLOCK_MONOTONIC) and handed
 * over through a ring, so that the step knows value, age and sequence.
 */
#ifndef FLOTILLA_DRIVER_H
#define FLOTILLA_DRIVER_H

#include <flotilla/block.h>
#include <flotilla/ring.h>

/* --- thread --- */

struct fl_driver;

/* Start `run(driver, context)` in a thread with locked memory, one priority below the task's: a device that floods
 * must not delay the control step. A stack has 256 kB, as have those of threads that the block's libraries make. NULL
 * after fl_fail(). */
struct fl_driver *fl_driver_start(struct fl_block *block, void (*run)(struct fl_driver *driver, void *context),
                                  void *context);

/* The same at ordinary priority, whatever the task's: for what writes files, or is in no hurry. Above the interrupts'
 * threads it would hold up serial ports, CAN and the network. */
struct fl_driver *fl_driver_start_ordinary(struct fl_block *block, void (*run)(struct fl_driver *driver, void *context),
                                           void *context);

/* Ask the thread to return and wait for it. NULL is allowed. */
void fl_driver_stop(struct fl_driver *driver);

/* Wait until `fd` is readable (or writable with `writable`), at most `timeout_ms` (-1: for ever; fd -1: only wait).
 * 1 ready, 0 time-out, -1 the thread shall return, -2 the device is gone (hang-up or error). */
int fl_driver_wait(const struct fl_driver *driver, int fd, bool writable, int timeout_ms);

/* Wait, in a block's `await`, until `fd` is readable: true; or CLOCK_MONOTONIC is `until_ns`: false. */
bool fl_await_readable(int fd, int64_t until_ns);

/* --- why a device is not good --- */

enum {
    FL_REASONS = 8,           /* that are told before the device has to be good again */
    FL_REASON_TEXT = 224,     /* bytes of one, with the 0 that ends it; a longer one is cut */
    FL_REASONS_STEADY_S = 10, /* seconds without any, after which each may be told again */
};

/* What a driver's thread has told of its device. All zero at first. */
struct fl_reasons {
    unsigned count;
    int64_t wrong_ns; /* when the newest reason was given, told or not */
    char told[FL_REASONS][FL_REASON_TEXT];
};

/* Log why the device is not good, unless the same text was logged already. For a driver's thread, as often as it likes:
 * never in a step, because it writes. */
void fl_reasons_tell(struct fl_reasons *reasons, struct fl_block *block, int64_t now_ns, const char *format, ...)
    __attribute__((format(printf, 4, 5)));

/* The device is good. Once it has been so for FL_REASONS_STEADY_S, what goes wrong then is told anew. */
void fl_reasons_good(struct fl_reasons *reasons, int64_t now_ns);

/* The same for what only a step sees: it stores, and a thread of ordinary priority looks once a second, and logs. */
struct fl_step_reasons;

/* Start the thread. NULL after fl_fail(). */
struct fl_step_reasons *fl_step_reasons_start(struct fl_block *block);

/* Why the device is not good in this step; for the step. `reason` has to last as long as the block. */
void fl_step_reasons_tell(struct fl_step_reasons *reasons, const char *reason);

/* NULL is allowed. */
void fl_step_reasons_stop(struct fl_step_reasons *reasons);

/* --- serial port --- */

/* Members and parameters of a block with a serial port, as the port's mask lists them. */
#define FL_SERIAL_MEMBERS                                                                                              \
    struct fl_device device;                                                                                           \
    int64_t baud;                                                                                                      \
    int64_t data_bits;                                                                                                 \
    int64_t stop_bits;                                                                                                 \
    int parity

#define FL_SERIAL_PARAMETERS(type, usual_baud)                                                                         \
    FL_PARAMETER(type, device, .summary = "serial port: /dev/robot/NAME"),                                             \
        FL_PARAMETER(type, baud, .fallback = (usual_baud), .min = 300, .max = 4000000, .unit = "Bd",                   \
                     .summary = "rate"),                                                                               \
        FL_PARAMETER(type, data_bits, .fallback = "8", .min = 5, .max = 8, .summary = "bits of a character"),          \
        FL_PARAMETER(type, stop_bits, .fallback = "1", .min = 1, .max = 2, .summary = "stop bits"),                    \
        FL_PARAMETER(type, parity, .fallback = "none", .choices = "none|odd|even", .summary = "parity bit")

struct fl_serial_settings {
    const char *device;
    int64_t baud, data_bits, stop_bits;
    int parity; /* index in "none|odd|even" */
};

#define FL_SERIAL_SETTINGS(parameters)                                                                                 \
    ((struct fl_serial_settings){(parameters)->device.path, (parameters)->baud, (parameters)->data_bits,               \
                                 (parameters)->stop_bits, (parameters)->parity})

/* Open a port: raw, exclusive, non-blocking. The descriptor, or -1 with errno; ERANGE: it cannot do the rate. */
int fl_serial_open(const struct fl_serial_settings *settings);

/* `silent_ms` of a protocol's `send` at the two ends of a conversation. */
enum { FL_SERIAL_OPENED = -1, FL_SERIAL_CLOSING = -2 };

/* A sensor on a serial port, told apart from its block so that it can be fed with any bytes in a test. */
struct fl_serial_protocol {
    size_t parser_size; /* bytes of the parser's state, zero at start and whenever the port is opened anew */
    size_t sample_size; /* bytes of a complete measurement */
    uint32_t records;   /* measurements that can wait for fl_serial_next, a power of two; 0: only the newest is kept */

    /* Take one byte. True when it completed a measurement, which is in `sample` then; nothing is written there else,
     * and the next byte may come with another place. */
    bool (*feed)(void *parser, uint8_t byte, void *sample);

    /* What to send now, at most `size` bytes into `out`; their number. NULL where nothing is ever sent. Called before
     * the first byte is fed (silent_ms is FL_SERIAL_OPENED), after each batch of bytes (0), about every 100 ms of
     * silence with its length so far, and before an orderly end (FL_SERIAL_CLOSING), which comes after whatever was
     * being sent when the end was asked for, and has half a second for both. */
    size_t (*send)(void *parser, const void *parameters, int silent_ms, uint8_t *out, size_t size);

    /* The rate to talk at from here on, in Bd; 0: the port's own parameter. Called after each `send`, before what that
     * gave is sent, so what was sent earlier must have left: wait for its answer. When the rate changes, bytes that
     * came and were not fed are dropped. At a rate that the port lacks no device answers. NULL: always the parameter.
     */
    int64_t (*baud)(const void *parser);

    /* Why bytes that were fed since the last call are no good measurement, and what to do about it: a wrong checksum,
     * another mode, a fault that the device tells. One line, which lasts until the next call; NULL: nothing is wrong.
     * Called after each batch of bytes and in silence; the thread logs it by fl_reasons_tell. NULL where the protocol
     * has nothing to add to what the thread finds by itself: no port, no bytes, bytes without a measurement. */
    const char *(*reason)(void *parser, const void *parameters);
};

enum { FL_SERIAL_PATIENCE_S = 5 }; /* seconds without a measurement or a reason, after which the thread says so */

struct fl_serial;

/* Start the thread that opens the port, reads, and opens it again whenever it was gone (unplugged). The device need not
 * be there yet: fl_serial_connected() says. NULL after fl_fail(). `parameters` is handed to the protocol's `send`. */
struct fl_serial *fl_serial_start(struct fl_block *block, const struct fl_serial_protocol *protocol,
                                  struct fl_serial_settings settings, const void *parameters);

/* The newest measurement since the last call into `sample`, when it arrived, and how many have arrived in all.
 * False, with nothing changed, when there is none. For the step. */
bool fl_serial_newest(struct fl_serial *serial, void *sample, int64_t *arrived_ns, uint32_t *sequence);

/* Every measurement in turn, for a block that needs each; its protocol says how many may wait. The number of those that
 * did not fit is the gap in `sequence`. */
bool fl_serial_next(struct fl_serial *serial, void *sample, int64_t *arrived_ns, uint32_t *sequence);

/* Whether the port is open: false from the moment the device is found to be gone. */
bool fl_serial_connected(const struct fl_serial *serial);

/* Queue bytes to be sent by the thread, from the step: after the next bytes arrive, or within 100 ms. False when the
 * port is not open or too many wait already. What waits when the port is lost is never sent: it would be a stale
 * command to whatever is plugged in next. */
bool fl_serial_send(struct fl_serial *serial, const uint8_t *bytes, size_t count);

/* Stop the thread and close the port. NULL is allowed. */
void fl_serial_stop(struct fl_serial *serial);

#endif
