/** frame-grabber-v4l2
 *
 * Grabs images of a camera of Linux's Video4Linux2, in shades of grey. A thread takes them from buffers that the
 * driver fills; the step copies the newest.
 *
 * Failure: The flag is 0 once no image came for `timeout`, and while the camera is not there. While the flag is 0 the
 * values stay the last good ones, and `age` grows. An image that is damaged is dropped. A camera that is missing, or
 * silent for 1 s, is opened again every 0.5 s; the journal says once what is wrong.
 */
#define _GNU_SOURCE
#include "grabber.h"

#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <math.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <unistd.h>

enum { BUFFERS = 4, REOPEN_MS = 500, SILENCE_MS = 1000 };

struct v4l2 {
    struct fl_device device;
    GRABBER_MEMBERS;
    double rate, exposure;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct v4l2, device, .flags = FL_CAMERA, .default_value = "/dev/video0", .summary = "the camera"),
    GRABBER_PARAMETERS(struct v4l2),
    FL_PARAMETER(struct v4l2, rate, .default_value = "0", .min = 0, .max = 1000, .unit = "1/s",
                 .summary = "images to take; 0 leaves it to the camera"),
    FL_PARAMETER(struct v4l2, exposure, .default_value = "0", .min = 0, .max = 10, .unit = "s",
                 .summary = "time of exposure; 0 leaves it to the camera"),
};

/* Formats with the brightness in bytes of their own, best first: it is in the first plane, a byte every `pitch`.
 * Compressed formats (MJPG, H264) would need a library. */
static const struct format {
    uint32_t code;
    uint8_t pitch, first;
} formats[] = {
    {V4L2_PIX_FMT_GREY, 1, 0},   {V4L2_PIX_FMT_NV12, 1, 0},   {V4L2_PIX_FMT_NV21, 1, 0}, {V4L2_PIX_FMT_NV16, 1, 0},
    {V4L2_PIX_FMT_YUV420, 1, 0}, {V4L2_PIX_FMT_YVU420, 1, 0}, {V4L2_PIX_FMT_YUYV, 2, 0}, {V4L2_PIX_FMT_YVYU, 2, 0},
    {V4L2_PIX_FMT_UYVY, 2, 1},   {V4L2_PIX_FMT_VYUY, 2, 1},   {V4L2_PIX_FMT_Y16, 2, 1}, /* least byte first */
};
enum { FORMATS = sizeof formats / sizeof formats[0] };

/* A camera that is open, and how its frames lie in memory. */
struct stream {
    int fd;
    const struct format *format;
    size_t width, height, stride;
    size_t count;
    struct {
        uint8_t *start;
        size_t bytes;
    } buffers[BUFFERS];
};

static bool request(int fd, unsigned long code, void *argument)
{
    int result;
    do
        result = ioctl(fd, code, argument);
    while (result < 0 && errno == EINTR);
    return result == 0;
}

static bool choose_format(struct stream *stream, const struct format *format, struct v4l2_pix_format *given)
{
    struct v4l2_format asked = {.type = V4L2_BUF_TYPE_VIDEO_CAPTURE};
    asked.fmt.pix = (struct v4l2_pix_format){.width = (uint32_t)stream->width,
                                             .height = (uint32_t)stream->height,
                                             .pixelformat = format->code,
                                             .field = V4L2_FIELD_NONE};
    /* A driver returns what it will do, which may differ from the request. */
    if (!request(stream->fd, VIDIOC_S_FMT, &asked) || asked.fmt.pix.pixelformat != format->code)
        return false;
    *given = asked.fmt.pix;
    size_t row = stream->width * format->pitch;
    stream->format = format;
    stream->stride = asked.fmt.pix.bytesperline ? asked.fmt.pix.bytesperline : row;
    return given->width == stream->width && given->height == stream->height && stream->stride >= row;
}

/* The codes of formats, as Linux writes them, in a line. */
struct codes {
    char text[96];
};

static void append(struct codes *codes, uint32_t code)
{
    size_t length = strlen(codes->text);
    snprintf(codes->text + length, sizeof codes->text - length, "%s%c%c%c%c", length ? " " : "", (char)(code & 0x7F),
             (char)(code >> 8 & 0x7F), (char)(code >> 16 & 0x7F), (char)(code >> 24 & 0x7F));
}

static void log_formats(struct grabber *grabber, const struct stream *stream, const char *path)
{
    struct codes usable = {""}, offered = {""};
    struct v4l2_fmtdesc described = {.type = V4L2_BUF_TYPE_VIDEO_CAPTURE};
    for (size_t i = 0; i < FORMATS; i++)
        append(&usable, formats[i].code);
    for (; described.index < 16 && request(stream->fd, VIDIOC_ENUM_FMT, &described); described.index++)
        append(&offered, described.pixelformat);
    GRABBER_TELL(grabber, "%s offers %s, of which none is read: take a camera with one of %s", path,
                 *offered.text ? offered.text : "no format", usable.text);
}

/* Choose the first format that the camera has in the wanted size; false after logging that there is none. */
static bool choose(struct grabber *grabber, struct stream *stream, const char *path)
{
    struct v4l2_pix_format given = {0};
    for (size_t i = 0; i < FORMATS; i++)
        if (choose_format(stream, &formats[i], &given))
            return true;
    if (given.width)
        GRABBER_TELL(grabber, "%s has images of %u x %u pixels, not of %zu x %zu: set width and height", path,
                     given.width, given.height, stream->width, stream->height);
    else
        log_formats(grabber, stream, path);
    return false;
}

/* Many a USB camera has a second device, for metadata. */
static bool is_camera(int fd)
{
    struct v4l2_capability able = {0};
    if (!request(fd, VIDIOC_QUERYCAP, &able))
        return false;
    uint32_t here = able.capabilities & V4L2_CAP_DEVICE_CAPS ? able.device_caps : able.capabilities;
    return here & V4L2_CAP_VIDEO_CAPTURE && here & V4L2_CAP_STREAMING;
}

/* A setting that the camera does not offer is left as it is; only the size is required. */
static void set_controls(const struct stream *stream, const struct v4l2 *set)
{
    if (set->rate > 0) {
        struct v4l2_streamparm timing = {.type = V4L2_BUF_TYPE_VIDEO_CAPTURE};
        timing.parm.capture.timeperframe = (struct v4l2_fract){1000, (uint32_t)lround(set->rate * 1000)};
        request(stream->fd, VIDIOC_S_PARM, &timing);
    }
    if (set->exposure > 0) {
        struct v4l2_control manual = {V4L2_CID_EXPOSURE_AUTO, V4L2_EXPOSURE_MANUAL};
        struct v4l2_control time = {V4L2_CID_EXPOSURE_ABSOLUTE, (int32_t)lround(set->exposure * 1e4)};
        request(stream->fd, VIDIOC_S_CTRL, &manual);
        request(stream->fd, VIDIOC_S_CTRL, &time);
    }
}

static struct v4l2_buffer buffer_of(uint32_t index)
{
    return (struct v4l2_buffer){.type = V4L2_BUF_TYPE_VIDEO_CAPTURE, .memory = V4L2_MEMORY_MMAP, .index = index};
}

static bool map_buffers(struct stream *stream)
{
    struct v4l2_requestbuffers wanted = {
        .count = BUFFERS, .type = V4L2_BUF_TYPE_VIDEO_CAPTURE, .memory = V4L2_MEMORY_MMAP};
    if (!request(stream->fd, VIDIOC_REQBUFS, &wanted) || wanted.count < 2)
        return false;
    for (uint32_t i = 0; i < wanted.count && i < BUFFERS; i++) {
        struct v4l2_buffer buffer = buffer_of(i);
        if (!request(stream->fd, VIDIOC_QUERYBUF, &buffer))
            return false;
        void *start = mmap(NULL, buffer.length, PROT_READ, MAP_SHARED, stream->fd, (off_t)buffer.m.offset);
        if (start == MAP_FAILED)
            return false;
        stream->buffers[i].start = start;
        stream->buffers[i].bytes = buffer.length;
        stream->count = i + 1;
        if (!request(stream->fd, VIDIOC_QBUF, &buffer))
            return false;
    }
    return true;
}

static void close_stream(struct stream *stream)
{
    for (size_t i = 0; i < stream->count; i++)
        munmap(stream->buffers[i].start, stream->buffers[i].bytes);
    close(stream->fd); /* ends the streaming too */
}

static bool open_stream(struct stream *stream, struct grabber *grabber)
{
    const struct v4l2 *set = grabber->parameters;
    const char *path = set->device.path;
    int type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
    *stream = (struct stream){
        .fd = open(path, O_RDWR | O_NONBLOCK | O_CLOEXEC), .width = (size_t)set->width, .height = (size_t)set->height};
    if (stream->fd < 0) {
        GRABBER_TELL(grabber, "cannot open %s: %s; retrying", path, strerror(errno));
        return false;
    }
    if (!is_camera(stream->fd)) {
        GRABBER_TELL(grabber, "%s is not a camera: set device to one of /dev/v4l/by-id that ends with index0", path);
    } else if (choose(grabber, stream, path)) {
        set_controls(stream, set);
        if (map_buffers(stream) && request(stream->fd, VIDIOC_STREAMON, &type))
            return true;
        GRABBER_TELL(grabber, "%s does not start: %s; retrying", path, strerror(errno));
    }
    close_stream(stream);
    return false;
}

/* Whether all rows lie within what the driver says it has filled. */
static bool complete(const struct stream *stream, const struct v4l2_buffer *buffer)
{
    size_t last_row = stream->width * stream->format->pitch;
    size_t needed = stream->stride * (stream->height - 1) + last_row;
    return !(buffer->flags & V4L2_BUF_FLAG_ERROR) && buffer->bytesused >= needed &&
           stream->buffers[buffer->index].bytes >= needed;
}

static void convert(const struct stream *stream, const uint8_t *from, uint8_t *to)
{
    const size_t pitch = stream->format->pitch, first = stream->format->first;
    for (size_t row = 0; row < stream->height; row++, from += stream->stride, to += stream->width) {
        if (pitch == 1) {
            memcpy(to, from, stream->width); /* mapped, as `index` < `count`: NOLINT(*NonNullParamChecker) */
        } else {
            for (size_t column = 0; column < stream->width; column++)
                to[column] = from[pitch * column + first]; /* likewise: NOLINT(*NullDereference) */
        }
    }
}

/* When the driver took it, in the clock that the task uses. */
static int64_t taken_ns(const struct v4l2_buffer *buffer)
{
    int64_t now_ns = fl_now_ns();
    if ((buffer->flags & V4L2_BUF_FLAG_TIMESTAMP_MASK) != V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC)
        return now_ns;
    int64_t stamp_ns = buffer->timestamp.tv_sec * INT64_C(1000000000) + buffer->timestamp.tv_usec * INT64_C(1000);
    return stamp_ns < now_ns ? stamp_ns : now_ns;
}

/* To be filled again. */
static bool give_back(const struct stream *stream, uint32_t index)
{
    struct v4l2_buffer buffer = buffer_of(index);
    return request(stream->fd, VIDIOC_QBUF, &buffer);
}

/* Take the newest of the frames that are ready; false when the camera is gone. */
static bool take(struct stream *stream, struct grabber *grabber)
{
    struct v4l2_buffer newest = buffer_of(0);
    bool any = false;
    for (size_t taken = 0; taken < stream->count; taken++) {
        struct v4l2_buffer buffer = buffer_of(0);
        if (!request(stream->fd, VIDIOC_DQBUF, &buffer)) {
            if (errno == EAGAIN || errno == EIO) /* none is left; EIO: the frame was lost */
                break;
            return false;
        }
        if (buffer.index >= stream->count)
            return false;
        bool usable = complete(stream, &buffer);
        if (!usable)
            GRABBER_TELL(grabber, "an image is incomplete: check the cable");
        if ((!usable || any) && !give_back(stream, usable ? newest.index : buffer.index))
            return false;
        grabber->published += usable && any;
        newest = usable ? buffer : newest;
        any |= usable;
    }
    if (!any)
        return true;
    convert(stream, stream->buffers[newest.index].start, grabber_pixels(grabber));
    grabber_publish(grabber, taken_ns(&newest));
    return give_back(stream, newest.index);
}

static void run(struct fl_driver *driver, void *context)
{
    struct grabber *grabber = context;
    struct stream stream;
    const struct v4l2 *set = grabber->parameters;
    do {
        if (!open_stream(&stream, grabber))
            continue;
        atomic_store(&grabber->connected, true);
        int ready;
        while ((ready = fl_driver_wait(driver, stream.fd, false, SILENCE_MS)) == 1 && take(&stream, grabber))
            ;
        atomic_store(&grabber->connected, false);
        /* Some cameras hang after a bus reset, so a silent camera is opened again. */
        if (ready == 0)
            GRABBER_TELL(grabber, "%s: no image for %d ms; restarting it", set->device.path, SILENCE_MS);
        else if (ready != -1)
            GRABBER_TELL(grabber, "%s is gone; retrying", set->device.path);
        close_stream(&stream);
    } while (fl_driver_wait(driver, -1, false, REOPEN_MS) == 0);
}

static int configure(struct fl_block *block)
{
    const struct v4l2 *set = block->parameters;
    if (set->width % 2)
        return fl_fail(block, "width %d is odd: cameras send pixels in pairs", (int)set->width);
    return grabber_configure(block, set->width, set->height);
}

static int start(struct fl_block *block)
{
    const struct v4l2 *set = block->parameters;
    return grabber_start(block, block->state, set->width, set->height, run);
}

static int step(struct fl_block *block)
{
    const struct v4l2 *set = block->parameters;
    grabber_step(block, block->state, set->timeout);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    grabber_stop(block->state);
}

FL_BLOCK(frame_grabber_v4l2) = {
    .abi = FL_ABI,
    .name = "frame-grabber-v4l2",
    .summary = "images of a Video4Linux2 camera, in shades of grey",
    .source = "Linux, Documentation/userspace-api/media/v4l",
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct v4l2),
    .state_size = sizeof(struct grabber),
    .configure = configure,
    .start = start,
    .step = step,
    .terminate = terminate,
};
