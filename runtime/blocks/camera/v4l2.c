/* The block `frame-grabber-v4l2`: a camera of Linux's Video4Linux2, streaming into buffers mapped from the driver. */
#define _GNU_SOURCE
#include "grabber.h"

#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <math.h>
#include <stdatomic.h>
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
    FL_PARAMETER(struct v4l2, device, .fallback = "/dev/video0", .summary = "the camera"),
    GRABBER_PARAMETERS(struct v4l2),
    FL_PARAMETER(struct v4l2, rate, .fallback = "0", .min = 0, .max = 1000, .unit = "1/s",
                 .summary = "images to take; 0 leaves it to the camera"),
    FL_PARAMETER(struct v4l2, exposure, .fallback = "0", .min = 0, .max = 10, .unit = "s",
                 .summary = "time of exposure; 0 leaves it to the camera"),
};

/* A camera that is open, and how its frames lie in memory. */
struct stream {
    int fd;
    uint32_t format; /* V4L2_PIX_FMT_GREY or V4L2_PIX_FMT_YUYV */
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

static bool choose_format(struct stream *stream, uint32_t format)
{
    struct v4l2_format asked = {.type = V4L2_BUF_TYPE_VIDEO_CAPTURE};
    asked.fmt.pix = (struct v4l2_pix_format){.width = (uint32_t)stream->width,
                                             .height = (uint32_t)stream->height,
                                             .pixelformat = format,
                                             .field = V4L2_FIELD_NONE};
    /* A driver answers with what it will do, which need not be what it was asked for. */
    if (!request(stream->fd, VIDIOC_S_FMT, &asked) || asked.fmt.pix.pixelformat != format ||
        asked.fmt.pix.width != stream->width || asked.fmt.pix.height != stream->height)
        return false;
    size_t row = stream->width * (format == V4L2_PIX_FMT_YUYV ? 2 : 1);
    stream->format = format;
    stream->stride = asked.fmt.pix.bytesperline ? asked.fmt.pix.bytesperline : row;
    return stream->stride >= row;
}

/* What a camera does not offer it keeps as it is: a wish, other than the size. */
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

static bool open_stream(struct stream *stream, const struct v4l2 *set)
{
    int type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
    *stream = (struct stream){.fd = open(set->device.path, O_RDWR | O_NONBLOCK | O_CLOEXEC),
                              .width = (size_t)set->width,
                              .height = (size_t)set->height};
    if (stream->fd < 0)
        return false;
    if (choose_format(stream, V4L2_PIX_FMT_GREY) || choose_format(stream, V4L2_PIX_FMT_YUYV)) {
        set_controls(stream, set);
        if (map_buffers(stream) && request(stream->fd, VIDIOC_STREAMON, &type))
            return true;
    }
    close_stream(stream);
    return false;
}

/* Whether all rows lie within what the driver says it has filled. */
static bool complete(const struct stream *stream, const struct v4l2_buffer *buffer)
{
    size_t last_row = stream->width * (stream->format == V4L2_PIX_FMT_YUYV ? 2 : 1);
    size_t needed = stream->stride * (stream->height - 1) + last_row;
    return !(buffer->flags & V4L2_BUF_FLAG_ERROR) && buffer->bytesused >= needed &&
           stream->buffers[buffer->index].bytes >= needed;
}

static void convert(const struct stream *stream, const uint8_t *from, uint8_t *to)
{
    for (size_t row = 0; row < stream->height; row++, from += stream->stride, to += stream->width) {
        if (stream->format == V4L2_PIX_FMT_GREY) {
            memcpy(to, from, stream->width);
        } else { /* Y0 U Y1 V: the brightness is every other byte */
            for (size_t column = 0; column < stream->width; column++)
                to[column] = from[2 * column]; /* mapped, as `index` < `count`: NOLINT(*NullDereference) */
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

/* Take the frame that is ready; false when the camera is gone. */
static bool take(struct stream *stream, struct frames *frames)
{
    struct v4l2_buffer buffer = buffer_of(0);
    if (!request(stream->fd, VIDIOC_DQBUF, &buffer))
        return errno == EAGAIN || errno == EIO; /* EIO: the frame was lost */
    if (buffer.index >= stream->count)
        return false;
    if (complete(stream, &buffer)) {
        convert(stream, stream->buffers[buffer.index].start, frames_back(frames));
        frames_publish(frames, taken_ns(&buffer));
    }
    return request(stream->fd, VIDIOC_QBUF, &buffer);
}

static void run(struct fl_driver *driver, void *context)
{
    struct grabber *grabber = context;
    struct stream stream;
    do {
        if (!open_stream(&stream, grabber->parameters))
            continue;
        atomic_store(&grabber->connected, true);
        /* A camera that is silent for long is begun anew: some hang after a bus reset. */
        while (fl_driver_wait(driver, stream.fd, false, SILENCE_MS) == 1 && take(&stream, &grabber->frames))
            ;
        atomic_store(&grabber->connected, false);
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
