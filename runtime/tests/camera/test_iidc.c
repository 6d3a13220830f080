/* The grabber against a libdc1394 that is this file's: one camera, or none. That a real camera accepts the modes and
 * the order of the calls only hardware can show. */
#define _GNU_SOURCE
#include "seccomp.h"
#include "testbed.h"

#include <dc1394/dc1394.h>
#include <pthread.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { WIDTH = 640, HEIGHT = 480, STRIDE = 700 };
#define GUID UINT64_C(0x00b09d0100a1b2c3)

static struct {
    pthread_mutex_t lock;
    pthread_cond_t changed;
    bool present, transmits, corrupt;
    int looked, lost; /* times that it was looked for; calls in a wrong order */
    int fds[2];
    dc1394video_mode_t mode;
    dc1394framerate_t rate;
    int32_t roi[2];
    float shutter;
    dc1394camera_t camera;
    dc1394camera_id_t ids[2];
    dc1394camera_list_t list;
    dc1394video_frame_t frame;
    bool waiting, out;
    uint8_t image[STRIDE * HEIGHT];
} bus = {.lock = PTHREAD_MUTEX_INITIALIZER, .changed = PTHREAD_COND_INITIALIZER};

#define LOCKED(statement)                                                                                              \
    do {                                                                                                               \
        pthread_mutex_lock(&bus.lock);                                                                                 \
        statement;                                                                                                     \
        pthread_cond_broadcast(&bus.changed);                                                                          \
        pthread_mutex_unlock(&bus.lock);                                                                               \
    } while (0)

/* --- the library --- */

dc1394_t *dc1394_new(void)
{
    return malloc(1);
}

void dc1394_free(dc1394_t *library)
{
    free(library);
}

dc1394error_t dc1394_log_register_handler(dc1394log_t type, void (*handler)(dc1394log_t, const char *, void *),
                                          void *user)
{
    (void)type;
    (void)handler;
    (void)user;
    return DC1394_SUCCESS;
}

dc1394error_t dc1394_camera_enumerate(dc1394_t *library, dc1394camera_list_t **list)
{
    assert_non_null(library);
    LOCKED(bus.looked++);
    bus.ids[0] = (dc1394camera_id_t){.guid = 1};
    bus.ids[1] = (dc1394camera_id_t){.guid = GUID};
    bus.list = (dc1394camera_list_t){.num = bus.present ? 2 : 0, .ids = bus.ids};
    *list = &bus.list;
    return DC1394_SUCCESS;
}

void dc1394_camera_free_list(dc1394camera_list_t *list)
{
    assert_ptr_equal(list, &bus.list);
}

dc1394camera_t *dc1394_camera_new(dc1394_t *library, uint64_t guid)
{
    (void)library;
    bus.camera.guid = guid;
    return &bus.camera;
}

void dc1394_camera_free(dc1394camera_t *camera)
{
    LOCKED(camera->guid = 0);
}

dc1394error_t dc1394_video_set_iso_speed(dc1394camera_t *camera, dc1394speed_t speed)
{
    (void)camera;
    return speed == DC1394_ISO_SPEED_400 ? DC1394_SUCCESS : DC1394_FAILURE;
}

dc1394error_t dc1394_video_set_mode(dc1394camera_t *camera, dc1394video_mode_t mode)
{
    (void)camera;
    bus.mode = mode;
    return DC1394_SUCCESS;
}

dc1394error_t dc1394_video_set_framerate(dc1394camera_t *camera, dc1394framerate_t rate)
{
    (void)camera;
    bus.rate = rate;
    return DC1394_SUCCESS;
}

dc1394error_t dc1394_format7_set_roi(dc1394camera_t *camera, dc1394video_mode_t mode, dc1394color_coding_t coding,
                                     int32_t packet, int32_t left, int32_t top, int32_t width, int32_t height)
{
    (void)camera;
    assert_int_equal(mode, DC1394_VIDEO_MODE_FORMAT7_0);
    assert_int_equal(coding, DC1394_COLOR_CODING_MONO8);
    assert_int_equal(packet, DC1394_USE_MAX_AVAIL);
    assert_int_equal(left | top, 0);
    bus.roi[0] = width;
    bus.roi[1] = height;
    return DC1394_SUCCESS;
}

dc1394error_t dc1394_feature_set_mode(dc1394camera_t *camera, dc1394feature_t feature, dc1394feature_mode_t mode)
{
    (void)camera;
    return feature == DC1394_FEATURE_SHUTTER && mode == DC1394_FEATURE_MODE_MANUAL ? DC1394_SUCCESS : DC1394_FAILURE;
}

dc1394error_t dc1394_feature_set_absolute_control(dc1394camera_t *camera, dc1394feature_t feature, dc1394switch_t on)
{
    (void)camera;
    return feature == DC1394_FEATURE_SHUTTER && on == DC1394_ON ? DC1394_SUCCESS : DC1394_FAILURE;
}

dc1394error_t dc1394_feature_set_absolute_value(dc1394camera_t *camera, dc1394feature_t feature, float value)
{
    (void)camera;
    (void)feature;
    bus.shutter = value;
    return DC1394_SUCCESS;
}

dc1394error_t dc1394_capture_setup(dc1394camera_t *camera, uint32_t buffers, uint32_t flags)
{
    (void)flags;
    assert_true(buffers >= 2);
    bus.lost += camera->guid == 0;
    LOCKED(socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0, bus.fds));
    return DC1394_SUCCESS;
}

dc1394error_t dc1394_video_set_transmission(dc1394camera_t *camera, dc1394switch_t on)
{
    (void)camera;
    LOCKED(bus.transmits = on == DC1394_ON);
    return DC1394_SUCCESS;
}

dc1394error_t dc1394_capture_stop(dc1394camera_t *camera)
{
    (void)camera;
    if (bus.fds[0])
        close(bus.fds[0]);
    if (bus.fds[1] > 0)
        close(bus.fds[1]);
    LOCKED(bus.fds[0] = bus.fds[1] = 0);
    return DC1394_SUCCESS;
}

int dc1394_capture_get_fileno(dc1394camera_t *camera)
{
    (void)camera;
    return bus.fds[0];
}

dc1394error_t dc1394_capture_dequeue(dc1394camera_t *camera, dc1394capture_policy_t policy, dc1394video_frame_t **frame)
{
    char token;
    (void)camera;
    assert_int_equal(policy, DC1394_CAPTURE_POLICY_POLL);
    *frame = NULL;
    if (!bus.present)
        return DC1394_FAILURE;
    if (read(bus.fds[0], &token, 1) == 1) {
        bus.lost += bus.out;
        LOCKED(bus.out = true);
        *frame = &bus.frame;
    }
    return DC1394_SUCCESS;
}

dc1394bool_t dc1394_capture_is_frame_corrupt(dc1394camera_t *camera, dc1394video_frame_t *frame)
{
    (void)camera;
    (void)frame;
    return bus.corrupt;
}

dc1394error_t dc1394_capture_enqueue(dc1394camera_t *camera, dc1394video_frame_t *frame)
{
    (void)camera;
    assert_ptr_equal(frame, &bus.frame);
    LOCKED(bus.waiting = bus.out = false);
    return DC1394_SUCCESS;
}

/* --- what a test does with it --- */

static void await(bool (*happened)(void))
{
    struct timespec limit;
    clock_gettime(CLOCK_REALTIME, &limit);
    limit.tv_sec += 20;
    pthread_mutex_lock(&bus.lock);
    while (!happened())
        assert_int_equal(pthread_cond_timedwait(&bus.changed, &bus.lock, &limit), 0);
    pthread_mutex_unlock(&bus.lock);
}

static bool transmits(void)
{
    return bus.transmits;
}

static bool taken(void)
{
    return !bus.waiting;
}

static int looked;

static bool looked_again(void)
{
    return bus.looked > looked + 1;
}

static void expose(uint8_t first, int64_t age_ms)
{
    struct timespec real;
    clock_gettime(CLOCK_REALTIME, &real);
    for (int row = 0; row < HEIGHT; row++)
        for (int column = 0; column < STRIDE; column++)
            bus.image[row * STRIDE + column] = (uint8_t)(column < WIDTH ? first + column + row : 0xEE);
    bus.frame = (dc1394video_frame_t){
        .image = bus.image,
        .size = {WIDTH, HEIGHT},
        .stride = STRIDE,
        .color_coding = DC1394_COLOR_CODING_MONO8,
        .timestamp = (uint64_t)(real.tv_sec * INT64_C(1000000) + real.tv_nsec / 1000 - age_ms * 1000)};
    LOCKED(bus.waiting = true);
    assert_int_equal(write(bus.fds[1], "", 1), 1);
    await(taken);
}

static struct fl_block *grabber(const char *name, const char *value)
{
    struct fl_block *block = testbed_block("frame-grabber-iidc", "timeout", "30", name, value, NULL);
    testbed_begin(block);
    return block;
}

static void look(struct fl_block *block)
{
    block->release_ns = fl_now_ns() - block->period_ns;
    assert_int_equal(testbed_step(block), FL_OK);
}

static void grabs(void **state)
{
    (void)state;
    bus.present = true;
    struct fl_block *block = grabber("guid", "00b09d0100a1b2c3");
    await(transmits);
    assert_true(bus.camera.guid == GUID); /* not the first */
    assert_int_equal(bus.mode, DC1394_VIDEO_MODE_640x480_MONO8);
    assert_int_equal(bus.rate, DC1394_FRAMERATE_15);
    look(block);
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    expose(3, 40);
    expose(9, 40);
    look(block);
    const uint8_t *image = testbed_output(block, "image");
    for (int row = 0; row < HEIGHT; row++)
        for (int column = 0; column < WIDTH; column++)
            assert_int_equal(image[row * WIDTH + column], (uint8_t)(9 + column + row));
    assert_int_equal(GET(block, "flag", uint8_t), 1);
    assert_int_equal(GET(block, "sequence", uint32_t), 2);
    assert_true(GET(block, "age", double) >= 0.040);
    bus.corrupt = true;
    expose(50, 0);
    bus.corrupt = false;
    look(block);
    assert_int_equal(GET(block, "sequence", uint32_t), 2);
    testbed_end(block);
    assert_false(bus.transmits);
    assert_true(bus.camera.guid == 0);
    assert_int_equal(bus.lost, 0);
}

static void waits_for_its_camera(void **state)
{
    (void)state;
    bus.present = false;
    looked = bus.looked;
    struct fl_block *block = grabber(NULL, NULL);
    await(looked_again);
    look(block);
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    bus.present = true;
    await(transmits);
    expose(1, 0);
    look(block);
    assert_int_equal(GET(block, "flag", uint8_t), 1);
    looked = bus.looked;
    bus.present = false; /* unplugged */
    assert_int_equal(write(bus.fds[1], "", 1), 1);
    await(looked_again);
    look(block);
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    testbed_end(block);
}

static void cuts_other_sizes_out(void **state)
{
    (void)state;
    bus.present = true;
    struct fl_block *block =
        testbed_block("frame-grabber-iidc", "width", "320", "height", "200", "shutter", "0.005", NULL);
    testbed_begin(block);
    await(transmits);
    assert_int_equal(bus.mode, DC1394_VIDEO_MODE_FORMAT7_0);
    assert_int_equal(bus.roi[0], 320);
    assert_int_equal(bus.roi[1], 200);
    assert_near((double)bus.shutter, 0.005, 1e-8);
    expose(1, 0); /* of another size than was asked for */
    look(block);
    assert_int_equal(GET(block, "sequence", uint32_t), 0);
    steps_under_seccomp(block, 3);
    testbed_end(block);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(
        strstr(testbed_refusal("frame-grabber-iidc", "guid", "b09d", NULL), "is not 16 hexadecimal digits"));
    assert_non_null(strstr(testbed_refusal("frame-grabber-iidc", "guid", "00b09d0100a1b2cx", NULL),
                           "is not 16 hexadecimal digits"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(grabs),
        cmocka_unit_test(waits_for_its_camera),
        cmocka_unit_test(cuts_other_sizes_out),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
