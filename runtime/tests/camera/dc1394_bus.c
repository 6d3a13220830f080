#define _GNU_SOURCE
#include "dc1394_bus.h"

#include <assert.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

struct bus bus = {.lock = PTHREAD_MUTEX_INITIALIZER, .changed = PTHREAD_COND_INITIALIZER};

/* To who waits for the camera's file; the other end takes it, or is closed. */
static void wake(void)
{
    if (bus.fds[1] > 0 && write(bus.fds[1], "", 1) != 1)
        abort();
}

void bus_fill(int64_t age_ms)
{
    struct timespec real;
    unsigned next = bus.filled % BUS_BUFFERS;
    clock_gettime(CLOCK_REALTIME, &real);
    if (!bus.transmits || bus.buffers[next].full)
        return;
    memcpy(bus.buffers[next].image, bus.image, sizeof bus.image);
    bus.buffers[next].frame = (dc1394video_frame_t){
        .image = bus.buffers[next].image,
        .size = {WIDTH, HEIGHT},
        .stride = STRIDE,
        .color_coding = DC1394_COLOR_CODING_MONO8,
        .timestamp = (uint64_t)(real.tv_sec * INT64_C(1000000) + real.tv_nsec / 1000 - age_ms * 1000)};
    bus.buffers[next].full = true;
    bus.filled++;
    wake();
}

void bus_expose(int64_t age_ms)
{
    LOCKED(bus_fill(age_ms));
}

void bus_unplug(void)
{
    LOCKED(bus.present = false; wake());
}

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
    assert(library);
    LOCKED({
        bus.looked++;
        bus.list = (dc1394camera_list_t){.num = bus.present ? 2 : 0, .ids = bus.ids};
    });
    bus.ids[0] = (dc1394camera_id_t){.guid = 1};
    bus.ids[1] = (dc1394camera_id_t){.guid = GUID};
    *list = &bus.list;
    return DC1394_SUCCESS;
}

void dc1394_camera_free_list(dc1394camera_list_t *list)
{
    assert(list == &bus.list);
    (void)list;
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
    assert(mode == DC1394_VIDEO_MODE_FORMAT7_0);
    assert(coding == DC1394_COLOR_CODING_MONO8);
    assert(packet == DC1394_USE_MAX_AVAIL);
    assert(left == 0 && top == 0);
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
    assert(buffers >= 2);
    bus.lost += camera->guid == 0;
    LOCKED({
        bus.filled = bus.taken = 0;
        for (unsigned i = 0; i < BUS_BUFFERS; i++)
            bus.buffers[i].full = false;
        socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0, bus.fds);
    });
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
    LOCKED({
        for (int i = 0; i < 2; i++)
            if (bus.fds[i] > 0)
                close(bus.fds[i]);
        bus.fds[0] = bus.fds[1] = 0;
    });
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
    bool present;
    (void)camera;
    assert(policy == DC1394_CAPTURE_POLICY_POLL);
    *frame = NULL;
    LOCKED(present = bus.present);
    if (!present)
        return DC1394_FAILURE;
    if (read(bus.fds[0], &token, 1) == 1) {
        LOCKED(*frame = &bus.buffers[bus.taken++ % BUS_BUFFERS].frame);
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
    unsigned given = 0;
    while (frame != &bus.buffers[given].frame)
        assert(++given < BUS_BUFFERS);
    LOCKED({
        if (bus.given_back)
            bus.given_back();
        bus.lost += !bus.buffers[given].full;
        bus.buffers[given].full = false;
    });
    return DC1394_SUCCESS;
}
