/* What all camera blocks share: a thread fills frames, a step copies the newest into the output.
 *
 * An image is a port of width * height bytes, row by row from the top left, 0 black and 255 white. It is plain data
 * like all other signals, and can be wired, recorded and checked as they are. That costs one copy of each frame in a
 * step; a step without a new frame copies nothing.
 */
#ifndef FLOTILLA_CAMERA_GRABBER_H
#define FLOTILLA_CAMERA_GRABBER_H

#include "core/newest.h"

#include <flotilla/driver.h>
#include <flotilla/sensor.h>

enum { GRABBER_SIDE = 2048 }; /* largest width and height: 12 MiB of buffers at most */

#define GRABBER_MEMBERS                                                                                                \
    int64_t width, height;                                                                                             \
    double timeout

#define GRABBER_PARAMETERS(type)                                                                                       \
    FL_PARAMETER(type, width, .default_value = "640", .min = 16, .max = GRABBER_SIDE, .unit = "pixel",                 \
                 .summary = "of the image"),                                                                           \
        FL_PARAMETER(type, height, .default_value = "480", .min = 16, .max = GRABBER_SIDE, .unit = "pixel",            \
                     .summary = "of the image"),                                                                       \
        FL_SENSOR_TIMEOUT(type, "0.5")

struct frame {
    int64_t at_ns;     /* when it was taken, CLOCK_MONOTONIC */
    uint32_t sequence; /* frames so far, this one included */
    uint8_t pixels[];
};

struct grabber {
    struct newest frames;
    uint32_t published; /* frames so far; the thread's */
    struct fl_driver *driver;
    const void *parameters;
    size_t bytes;
    _Atomic bool connected; /* the thread's: the camera streams */
    struct fl_sensor sensor;
    struct fl_block *block; /* the thread's, to log why there are no images */
    struct fl_reasons reasons;
};

/* Log why there are no images, once (fl_reasons_log). For the thread. */
#define GRABBER_TELL(grabber, ...) fl_reasons_log(&(grabber)->reasons, (grabber)->block, fl_now_ns(), __VA_ARGS__)

/* For the thread: where the next frame goes. */
uint8_t *grabber_pixels(struct grabber *grabber);

/* For the thread: hand over that frame, and note that the camera is good. */
void grabber_publish(struct grabber *grabber, int64_t at_ns);

/* Add the outputs image, flag, age and sequence. */
int grabber_configure(struct fl_block *block, int64_t width, int64_t height);

/* Allocate, and start the thread `run(driver, grabber)`, which serves the camera until it has to return. */
int grabber_start(struct fl_block *block, struct grabber *grabber, int64_t width, int64_t height,
                  void (*run)(struct fl_driver *driver, void *grabber));

void grabber_step(struct fl_block *block, struct grabber *grabber, double timeout);

void grabber_stop(struct grabber *grabber);

#endif
