/* The grabber against a camera made of this file's own open, ioctl and mmap: no computer that runs the tests has one.
 * What this cannot show is what drivers do beyond their documentation. */
#define _GNU_SOURCE
#include "said.h"
#include "seccomp.h"
#include "testbed.h"

#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <poll.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <unistd.h>

enum { WIDTH = 32, HEIGHT = 16, STRIDE = 80, BUFFERS = 3, LENGTH = 4096 };

/* --- the camera --- */

static struct {
    pthread_mutex_t lock;
    pthread_cond_t changed;
    bool present, wrong_size, streaming;
    uint32_t format, able; /* the one that it has, and what it can do: V4L2_CAP_... */
    int fd, far_fd;        /* its file, and the end that this test writes to: a byte for each frame */
    int memory_fd;
    uint8_t *memory;
    uint32_t queue[8], ready[8]; /* buffers that the driver may fill, and those that are filled */
    struct v4l2_buffer filled[8];
    size_t queued, filled_count;
    int opened, started;
    struct v4l2_fract interval;
    int32_t exposure;
    struct fl_block *looking; /* it makes a step whenever a buffer is given back, */
    uint8_t seen[8];          /* and has this brightness then */
    size_t seen_count;
} camera = {.lock = PTHREAD_MUTEX_INITIALIZER, .changed = PTHREAD_COND_INITIALIZER, .fd = -1, .far_fd = -1};

static int refuse(int error)
{
    errno = error;
    return -1;
}

int open(const char *path, int flags, ...)
{
    int ends[2];
    if (strcmp(path, "/dev/video-test") != 0) {
        va_list arguments;
        va_start(arguments, flags);
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(arguments, mode_t) : 0;
        va_end(arguments);
        return openat(AT_FDCWD, path, flags, mode);
    }
    pthread_mutex_lock(&camera.lock);
    camera.opened++;
    bool present = camera.present;
    if (present && socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0, ends) == 0) {
        camera.fd = ends[0];
        camera.far_fd = ends[1];
        camera.queued = camera.filled_count = 0;
        camera.streaming = false;
    }
    pthread_cond_broadcast(&camera.changed);
    pthread_mutex_unlock(&camera.lock);
    return present ? ends[0] : refuse(ENOENT);
}

static int set_format(struct v4l2_pix_format *format)
{
    format->pixelformat = camera.format; /* as drivers do: what it would do instead */
    if (camera.wrong_size)
        format->width = 640;
    format->bytesperline = STRIDE;
    return 0;
}

static int dequeue(struct v4l2_buffer *buffer)
{
    char token;
    if (read(camera.fd, &token, 1) != 1)
        return refuse(EAGAIN);
    *buffer = camera.filled[0];
    camera.filled_count--;
    memmove(camera.filled, camera.filled + 1, camera.filled_count * sizeof camera.filled[0]);
    return 0;
}

static int answer(unsigned long code, void *argument)
{
    struct v4l2_buffer *buffer = argument;
    if (!camera.present)
        return refuse(ENODEV);
    switch (code) {
    case VIDIOC_QUERYCAP:
        if (!camera.able)
            return refuse(ENOTTY);
        ((struct v4l2_capability *)argument)->capabilities =
            V4L2_CAP_DEVICE_CAPS | V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING; /* of all devices of the camera */
        ((struct v4l2_capability *)argument)->device_caps = camera.able;
        return 0;
    case VIDIOC_ENUM_FMT:
        if (((struct v4l2_fmtdesc *)argument)->index > 1)
            return refuse(EINVAL);
        ((struct v4l2_fmtdesc *)argument)->pixelformat =
            ((struct v4l2_fmtdesc *)argument)->index ? V4L2_PIX_FMT_H264 : camera.format;
        return 0;
    case VIDIOC_S_FMT:
        return set_format(&((struct v4l2_format *)argument)->fmt.pix);
    case VIDIOC_S_PARM:
        camera.interval = ((struct v4l2_streamparm *)argument)->parm.capture.timeperframe;
        return 0;
    case VIDIOC_S_CTRL:
        if (((struct v4l2_control *)argument)->id == V4L2_CID_EXPOSURE_ABSOLUTE)
            camera.exposure = ((struct v4l2_control *)argument)->value;
        return 0;
    case VIDIOC_REQBUFS:
        ((struct v4l2_requestbuffers *)argument)->count = BUFFERS; /* fewer than were asked for */
        return 0;
    case VIDIOC_QUERYBUF:
        buffer->length = LENGTH;
        buffer->m.offset = buffer->index * LENGTH;
        return 0;
    case VIDIOC_QBUF:
        if (camera.looking) {
            testbed_step(camera.looking);
            camera.seen[camera.seen_count++] = *(const uint8_t *)testbed_output(camera.looking, "image");
        }
        camera.queue[camera.queued++] = buffer->index;
        return 0;
    case VIDIOC_DQBUF:
        return dequeue(buffer);
    case VIDIOC_STREAMON:
        camera.streaming = true;
        camera.started++;
        return 0;
    default:
        return refuse(ENOTTY);
    }
}

int ioctl(int fd, unsigned long code, ...)
{
    va_list arguments;
    va_start(arguments, code);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    assert_int_equal(fd, camera.fd);
    pthread_mutex_lock(&camera.lock);
    int result = answer(code, argument);
    int error = errno;
    pthread_cond_broadcast(&camera.changed);
    pthread_mutex_unlock(&camera.lock);
    errno = error;
    return result;
}

void *mmap(void *address, size_t length, int protection, int flags, int fd, off_t offset)
{
    typedef void *(*function)(void *, size_t, int, int, int, off_t);
    static function real;
    if (!real)
        real = (function)(uintptr_t)dlsym(RTLD_NEXT, sizeof(off_t) > sizeof(long) ? "mmap64" : "mmap");
    return real(address, length, protection, flags, fd >= 0 && fd == camera.fd ? camera.memory_fd : fd, offset);
}

/* --- what a test does with it --- */

static void plug(uint32_t format)
{
    pthread_mutex_lock(&camera.lock);
    camera.present = true;
    camera.format = format;
    camera.able = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
    pthread_mutex_unlock(&camera.lock);
}

static void unplug(void)
{
    pthread_mutex_lock(&camera.lock);
    camera.present = camera.streaming = false;
    close(camera.far_fd); /* the grabber's end hangs up */
    pthread_mutex_unlock(&camera.lock);
}

/* Wait for what the grabber's thread brings about. */
static void await(bool (*happened)(void))
{
    struct timespec limit;
    clock_gettime(CLOCK_REALTIME, &limit);
    limit.tv_sec += 20;
    pthread_mutex_lock(&camera.lock);
    while (!happened())
        assert_int_equal(pthread_cond_timedwait(&camera.changed, &camera.lock, &limit), 0);
    pthread_mutex_unlock(&camera.lock);
}

static bool streams(void)
{
    return camera.streaming;
}

static bool all_queued(void)
{
    return camera.filled_count == 0 && camera.queued == BUFFERS;
}

static int openings;

static bool opened_again(void)
{
    return camera.opened > openings + 1;
}

/* Where the brightness of a pixel is in a row: Linux, Documentation/userspace-api/media/v4l, "YUV Formats". */
static int place_of(uint32_t format, int column)
{
    switch (format) {
    case V4L2_PIX_FMT_YUYV: /* Y0 U Y1 V */
    case V4L2_PIX_FMT_YVYU:
        return 2 * column;
    case V4L2_PIX_FMT_UYVY: /* U Y0 V Y1 */
    case V4L2_PIX_FMT_VYUY:
    case V4L2_PIX_FMT_Y16: /* the high byte is the second */
        return 2 * column + 1;
    default: /* a plane of their own */
        return column;
    }
}

/* The same as expose, with the lock held. */
static void fill(uint8_t first, uint32_t flags, uint32_t bytes, int64_t at_ns)
{
    char token = 0;
    assert_true(camera.queued > 0);
    uint32_t index = camera.queue[0];
    uint8_t *memory = camera.memory + index * LENGTH;
    memmove(camera.queue, camera.queue + 1, --camera.queued * sizeof camera.queue[0]);
    memset(memory, 0xEE, LENGTH);
    for (int row = 0; row < HEIGHT; row++)
        for (int column = 0; column < WIDTH; column++)
            memory[row * STRIDE + place_of(camera.format, column)] = (uint8_t)(first + column + row);
    camera.filled[camera.filled_count++] = (struct v4l2_buffer){
        .index = index,
        .type = V4L2_BUF_TYPE_VIDEO_CAPTURE,
        .memory = V4L2_MEMORY_MMAP,
        .bytesused = bytes,
        .flags = flags,
        .timestamp = {.tv_sec = (time_t)(at_ns / 1000000000), .tv_usec = (suseconds_t)(at_ns % 1000000000 / 1000)},
    };
    assert_int_equal(write(camera.far_fd, &token, 1), 1);
}

/* Expose a frame: pixel (column, row) has the brightness first + column + row, in the camera's format. */
static void expose(uint8_t first, uint32_t flags, uint32_t bytes, int64_t at_ns)
{
    pthread_mutex_lock(&camera.lock);
    fill(first, flags, bytes, at_ns);
    pthread_mutex_unlock(&camera.lock);
    await(all_queued); /* it was taken, and its buffer given back */
}

static struct fl_block *grabber(const char *more, const char *value)
{
    struct fl_block *block = testbed_block("frame-grabber-v4l2", "device", "/dev/video-test", "width", "32", "height",
                                           "16", "timeout", "30", more, value, NULL);
    testbed_begin(block);
    return block;
}

static void look(struct fl_block *block)
{
    block->release_ns = fl_now_ns() - block->period_ns;
    assert_int_equal(testbed_step(block), FL_OK);
}

static void assert_image(struct fl_block *block, uint8_t first)
{
    const uint8_t *image = testbed_output(block, "image");
    for (int row = 0; row < HEIGHT; row++)
        for (int column = 0; column < WIDTH; column++)
            assert_int_equal(image[row * WIDTH + column], (uint8_t)(first + column + row));
}

static void grabs(uint32_t format)
{
    plug(format);
    struct fl_block *block = grabber(NULL, NULL);
    await(streams);
    look(block);
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    int64_t at_ns = fl_now_ns() - 30000000;
    expose(10, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, LENGTH, at_ns);
    look(block);
    assert_image(block, 10);
    assert_int_equal(GET(block, "flag", uint8_t), 1);
    assert_int_equal(GET(block, "sequence", uint32_t), 1);
    assert_near(GET(block, "age", double), (double)(block->release_ns - at_ns) * 1e-9, 1e-6);
    for (uint8_t frame = 0; frame < 10; frame++)
        expose((uint8_t)(50 + frame), V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, LENGTH, fl_now_ns());
    look(block);
    assert_image(block, 59); /* the newest */
    assert_int_equal(GET(block, "sequence", uint32_t), 11);
    block->release_ns += INT64_C(31000000000);
    assert_int_equal(testbed_step(block), FL_OK);
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    testbed_end(block);
}

static int forget(void **state)
{
    (void)state;
    close(camera.far_fd);
    camera.present = camera.streaming = false;
    camera.fd = camera.far_fd = -1;
    return 0;
}

static void grabs_each_format_with_the_brightness_in_it(void **state)
{
    static const uint32_t formats[] = {
        V4L2_PIX_FMT_GREY,   V4L2_PIX_FMT_NV12,   V4L2_PIX_FMT_NV21, V4L2_PIX_FMT_NV16,
        V4L2_PIX_FMT_YUV420, V4L2_PIX_FMT_YVU420, V4L2_PIX_FMT_YUYV, V4L2_PIX_FMT_YVYU,
        V4L2_PIX_FMT_UYVY,   V4L2_PIX_FMT_VYUY,   V4L2_PIX_FMT_Y16,
    };
    for (size_t i = 0; i < sizeof formats / sizeof formats[0]; i++) {
        grabs(formats[i]);
        forget(state);
    }
}

/* A camera that cannot be used says nothing by itself. */
static void says_what_is_wrong(void **state)
{
    static const struct {
        uint32_t format, able;
        bool absent, wrong_size;
        const char *said;
    } cases[] = {
        {.absent = true, .said = "cannot open /dev/video-test: No such file or directory; retrying"},
        {.able = 0, .said = "/dev/video-test is not a camera: set device to"},
        {.able = V4L2_CAP_META_CAPTURE | V4L2_CAP_STREAMING, .said = "/dev/video-test is not a camera: set device to"},
        {.format = V4L2_PIX_FMT_MJPEG,
         .able = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING,
         .said = "/dev/video-test offers MJPG H264, of which none is read: take a camera with one of GREY NV12 "},
        {.format = V4L2_PIX_FMT_UYVY,
         .able = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING,
         .wrong_size = true,
         .said = "/dev/video-test has images of 640 x 16 pixels, not of 32 x 16: set width and height"},
    };
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        struct said said = said_begin();
        plug(cases[i].format);
        camera.present = !cases[i].absent;
        camera.able = cases[i].able;
        camera.wrong_size = cases[i].wrong_size;
        openings = camera.opened;
        struct fl_block *block = grabber(NULL, NULL);
        await(opened_again);
        testbed_end(block);
        assert_int_equal(said_times(&said, cases[i].said), 1);
        assert_int_equal(said_times(&said, "frame-grabber-v4l2: "), 1);
        camera.wrong_size = false;
        forget(state);
        said_end(&said);
    }
}

/* Frames that wait for the thread: no step gets an older one. Seen to fail: steps saw 10, then 20, then 30. */
static void passes_over_all_but_the_newest(void **state)
{
    (void)state;
    plug(V4L2_PIX_FMT_GREY);
    struct fl_block *block = grabber(NULL, NULL);
    await(streams);
    pthread_mutex_lock(&camera.lock);
    camera.looking = block;
    for (uint8_t first = 10; first <= 10 * BUFFERS; first = (uint8_t)(first + 10))
        fill(first, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, LENGTH, fl_now_ns());
    pthread_mutex_unlock(&camera.lock);
    await(all_queued);
    camera.looking = NULL;
    assert_int_equal(camera.seen_count, BUFFERS);
    for (size_t i = 0; i < camera.seen_count; i++)
        assert_int_equal(camera.seen[i], i + 1 < camera.seen_count ? 0 : 10 * BUFFERS);
    assert_int_equal(GET(block, "sequence", uint32_t), BUFFERS);
    testbed_end(block);
}

static void leaves_out_bad_frames(void **state)
{
    (void)state;
    plug(V4L2_PIX_FMT_GREY);
    struct fl_block *block = grabber(NULL, NULL);
    await(streams);
    expose(1, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, LENGTH, fl_now_ns());
    expose(2, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC | V4L2_BUF_FLAG_ERROR, LENGTH, fl_now_ns());
    expose(3, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, STRIDE * (HEIGHT - 1) + WIDTH - 1, fl_now_ns()); /* a byte short */
    look(block);
    assert_image(block, 1);
    assert_int_equal(GET(block, "sequence", uint32_t), 1);
    expose(4, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, STRIDE * (HEIGHT - 1) + WIDTH, fl_now_ns());
    look(block);
    assert_image(block, 4);
    testbed_end(block);
}

/* A stamp of another clock, or of the future, is not believed. */
static void stamps_in_the_tasks_clock(void **state)
{
    (void)state;
    plug(V4L2_PIX_FMT_GREY);
    struct fl_block *block = grabber(NULL, NULL);
    await(streams);
    expose(1, V4L2_BUF_FLAG_TIMESTAMP_UNKNOWN, LENGTH, 5);
    look(block);
    assert_int_equal(GET(block, "flag", uint8_t), 1);
    expose(2, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, LENGTH, fl_now_ns() + INT64_C(3600000000000));
    look(block);
    block->release_ns += INT64_C(31000000000);
    assert_int_equal(testbed_step(block), FL_OK);
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    testbed_end(block);
}

static void returns_after_unplugging(void **state)
{
    (void)state;
    plug(V4L2_PIX_FMT_GREY);
    struct fl_block *block = grabber(NULL, NULL);
    await(streams);
    expose(1, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, LENGTH, fl_now_ns());
    openings = camera.opened;
    unplug();
    await(opened_again); /* it has looked for it at least twice */
    look(block);
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    plug(V4L2_PIX_FMT_YUYV);
    await(streams);
    expose(90, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, LENGTH, fl_now_ns());
    look(block);
    assert_image(block, 90);
    assert_int_equal(GET(block, "flag", uint8_t), 1);
    assert_int_equal(GET(block, "sequence", uint32_t), 2);
    testbed_end(block);
}

static void takes_no_other_size(void **state)
{
    (void)state;
    plug(V4L2_PIX_FMT_GREY);
    camera.wrong_size = true;
    openings = camera.opened;
    int started = camera.started;
    struct fl_block *block = grabber(NULL, NULL);
    await(opened_again);
    assert_int_equal(camera.started, started);
    camera.wrong_size = false;
    await(streams);
    testbed_end(block);
}

static void sets_what_is_asked_for(void **state)
{
    (void)state;
    plug(V4L2_PIX_FMT_GREY);
    struct fl_block *block = grabber("rate", "12.5");
    await(streams);
    assert_near((double)camera.interval.denominator / camera.interval.numerator, 12.5, 1e-9);
    assert_int_equal(camera.exposure, 0);
    testbed_end(block);
    camera.streaming = false;
    block = grabber("exposure", "0.002");
    await(streams);
    assert_int_equal(camera.exposure, 20); /* in 100 us */
    testbed_end(block);
}

static void steps_never_block(void **state)
{
    (void)state;
    plug(V4L2_PIX_FMT_GREY);
    struct fl_block *block = grabber(NULL, NULL);
    await(streams);
    expose(1, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, LENGTH, fl_now_ns());
    steps_under_seccomp(block, 5);
    testbed_end(block);
}

static int prepare(void **state)
{
    (void)state;
    camera.memory_fd = memfd_create("camera", MFD_CLOEXEC);
    if (camera.memory_fd < 0 || ftruncate(camera.memory_fd, BUFFERS * LENGTH) < 0)
        return -1;
    camera.memory = mmap(NULL, BUFFERS * LENGTH, PROT_READ | PROT_WRITE, MAP_SHARED, camera.memory_fd, 0);
    return camera.memory == MAP_FAILED ? -1 : 0;
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_teardown(grabs_each_format_with_the_brightness_in_it, forget),
        cmocka_unit_test_teardown(says_what_is_wrong, forget),
        cmocka_unit_test_teardown(passes_over_all_but_the_newest, forget),
        cmocka_unit_test_teardown(leaves_out_bad_frames, forget),
        cmocka_unit_test_teardown(stamps_in_the_tasks_clock, forget),
        cmocka_unit_test_teardown(returns_after_unplugging, forget),
        cmocka_unit_test_teardown(takes_no_other_size, forget),
        cmocka_unit_test_teardown(sets_what_is_asked_for, forget),
        cmocka_unit_test_teardown(steps_never_block, forget),
    };
    return cmocka_run_group_tests(tests, prepare, NULL);
}
