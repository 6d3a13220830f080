/* What a block that drives a device needs: a thread of its own for the I/O, and the serial port.
 *
 * The thread may block; the step of the block never does. The thread stamps what arrives (CLOCK_MONOTONIC) and hands it
 * to the step through a ring, so the step knows value, age and sequence.
 */
#ifndef FLOTILLA_DRIVER_H
#define FLOTILLA_DRIVER_H

#include <flotilla/block.h>
#include <flotilla/ring.h>

/* --- thread --- */

struct fl_driver;

/* Start `run(driver, context)` in a thread with locked memory, one priority below the task: a device that floods must
 * not delay the control step. Its stack has 256 kB, as have those of threads that libraries of the block start. NULL
 * after fl_fail(). */
struct fl_driver *fl_driver_start(struct fl_block *block, void (*run)(struct fl_driver *driver, void *context),
                                  void *context);

/* The same at ordinary priority, whatever the priority of the task: for a thread that writes files or is in no hurry.
 * Above the threads of interrupts it would delay serial ports, CAN and the network. */
struct fl_driver *fl_driver_start_ordinary(struct fl_block *block, void (*run)(struct fl_driver *driver, void *context),
                                           void *context);

/* Ask the thread to return, and wait until it has. NULL is allowed. */
void fl_driver_stop(struct fl_driver *driver);

/* Wait until `fd` is readable (or writable with `writable`), at most `timeout_ms` (-1: no limit; fd -1: only wait). 1
 * ready, 0 time-out, -1 the thread has to return, -2 the device is gone (hang-up or error). */
int fl_driver_wait(const struct fl_driver *driver, int fd, bool writable, int timeout_ms);

/* For `await` of a block: wait until `fd` is readable (true), or CLOCK_MONOTONIC is `until_ns` (false). */
bool fl_await_readable(int fd, int64_t until_ns);

/* --- why a device is not good --- */

enum {
    FL_REASONS = 8,           /* reasons that are logged until the device is good again */
    FL_REASON_TEXT = 224,     /* bytes of a reason, with the terminating 0; a longer one is cut */
    FL_REASONS_STEADY_S = 10, /* seconds without a reason, after which each may be logged again */
};

/* The reasons that a driver's thread has logged. All zero at first. */
struct fl_reasons {
    unsigned count;
    int64_t wrong_ns; /* when the newest reason was given, logged or not */
    char logged[FL_REASONS][FL_REASON_TEXT];
};

/* Log why the device is not good, unless the same text was logged already. For the thread of a driver, as often as it
 * likes; never in a step, because it writes. */
void fl_reasons_log(struct fl_reasons *reasons, struct fl_block *block, int64_t now_ns, const char *format, ...)
    __attribute__((format(printf, 4, 5)));

/* The device is good. Once it has been good for FL_REASONS_STEADY_S, later reasons are logged again. */
void fl_reasons_good(struct fl_reasons *reasons, int64_t now_ns);

/* The same for faults that only a step sees: the step stores the reason, and a thread of ordinary priority logs it
 * within a second. */
struct fl_step_reasons;

/* Start the thread. NULL after fl_fail(). */
struct fl_step_reasons *fl_step_reasons_start(struct fl_block *block);

/* Why the device is not good, for the step. `reason` has to last as long as the block. */
void fl_step_reasons_log(struct fl_step_reasons *reasons, const char *reason);

/* NULL is allowed. */
void fl_step_reasons_stop(struct fl_step_reasons *reasons);

/* --- serial port --- */

/* Members and parameters of a block with a serial port. */
#define FL_SERIAL_MEMBERS                                                                                              \
    struct fl_device device;                                                                                           \
    int64_t baud;                                                                                                      \
    int64_t data_bits;                                                                                                 \
    int64_t stop_bits;                                                                                                 \
    int parity

#define FL_SERIAL_PARAMETERS(type, usual_baud)                                                                         \
    FL_PARAMETER(type, device, .summary = "serial port: /dev/robot/NAME"),                                             \
        FL_PARAMETER(type, baud, .default_value = (usual_baud), .min = 300, .max = 4000000, .unit = "Bd",              \
                     .summary = "rate"),                                                                               \
        FL_PARAMETER(type, data_bits, .default_value = "8", .min = 5, .max = 8, .summary = "bits of a character"),     \
        FL_PARAMETER(type, stop_bits, .default_value = "1", .min = 1, .max = 2, .summary = "stop bits"),               \
        FL_PARAMETER(type, parity, .default_value = "none", .choices = "none|odd|even", .summary = "parity bit")

struct fl_serial_settings {
    const char *device;
    int64_t baud, data_bits, stop_bits;
    int parity; /* index in "none|odd|even" */
};

#define FL_SERIAL_SETTINGS(parameters)                                                                                 \
    ((struct fl_serial_settings){(parameters)->device.path, (parameters)->baud, (parameters)->data_bits,               \
                                 (parameters)->stop_bits, (parameters)->parity})

/* Open a port: raw, exclusive, non-blocking. Returns the descriptor, or -1 with errno; ERANGE: the port cannot do the
 * rate. */
int fl_serial_open(const struct fl_serial_settings *settings);

/* `silent_ms` of a protocol's `send` at the begin and the end of a connection. */
enum { FL_SERIAL_OPENED = -1, FL_SERIAL_CLOSING = -2 };

/* The protocol of a sensor on a serial port, separate from its block so that a test can feed it any bytes. */
struct fl_serial_protocol {
    size_t parser_size; /* bytes of the parser's state, zero at start and each time the port is opened */
    size_t sample_size; /* bytes of a complete measurement */
    uint32_t records;   /* measurements that can wait for fl_serial_next, a power of two; 0: only the newest is kept */

    /* Take one byte. True when it completed a measurement, which is in `sample` then; otherwise `sample` is not
     * written. `sample` may differ from call to call. */
    bool (*feed)(void *parser, uint8_t byte, void *sample);

    /* Write what to send now, at most `size` bytes, to `out`; returns their number. NULL where nothing is ever sent.
     * Called before the first byte is fed (silent_ms is FL_SERIAL_OPENED), after each batch of bytes (0), about every
     * 100 ms of silence (its length so far), and before an orderly end (FL_SERIAL_CLOSING). The end waits until what is
     * being sent has left, half a second at most for both. */
    size_t (*send)(void *parser, const void *parameters, int silent_ms, uint8_t *out, size_t size);

    /* The rate to use from now on, in Bd; 0: the parameter of the port. Called after each `send`, before its bytes are
     * sent. So bytes sent earlier must have left: wait for their answer. When the rate changes, received bytes that
     * were not fed are dropped. At a rate that the port cannot do, no device answers. NULL: always the parameter. */
    int64_t (*baud)(const void *parser);

    /* Why bytes fed since the last call are not a good measurement, and what to do about it: a wrong checksum, another
     * mode, a fault that the device reports. One line, valid until the next call; NULL: nothing is wrong. Called after
     * each batch of bytes and in silence; the thread logs it by fl_reasons_log. NULL where the protocol adds nothing
     * to what the thread finds by itself: no port, no bytes, bytes without a measurement. */
    const char *(*reason)(void *parser, const void *parameters);
};

enum { FL_SERIAL_PATIENCE_S = 5 }; /* seconds without a measurement or a reason, after which the thread reports it */

struct fl_serial;

/* Start the thread that opens the port, reads, and opens the port again after it was lost (unplugged). The device need
 * not be there yet: see fl_serial_connected(). NULL after fl_fail(). `parameters` is handed to `send` of the protocol.
 */
struct fl_serial *fl_serial_start(struct fl_block *block, const struct fl_serial_protocol *protocol,
                                  struct fl_serial_settings settings, const void *parameters);

/* For the step: copy the newest measurement since the last call to `sample`, with its time of arrival and the number of
 * measurements so far. False, with nothing changed, when there is none. */
bool fl_serial_newest(struct fl_serial *serial, void *sample, int64_t *arrived_ns, uint32_t *sequence);

/* For the step of a block that needs every measurement: copy the next one. `records` of the protocol says how many may
 * wait; a gap in `sequence` is the number of those that found no room. */
bool fl_serial_next(struct fl_serial *serial, void *sample, int64_t *arrived_ns, uint32_t *sequence);

/* Whether the port is open: false as soon as the device is found to be gone. */
bool fl_serial_connected(const struct fl_serial *serial);

/* For the step: queue bytes for the thread, which sends them after the next bytes arrive, or within 100 ms. False when
 * the port is not open or the queue is full. Bytes that wait when the port is lost are never sent: they would be a
 * stale command to whatever is plugged in next. */
bool fl_serial_send(struct fl_serial *serial, const uint8_t *bytes, size_t count);

/* Stop the thread and close the port. NULL is allowed. */
void fl_serial_stop(struct fl_serial *serial);

#endif
