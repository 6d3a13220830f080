/** frame-grabber-iidc
 *
 * Grabs images of a FireWire camera by libdc1394, over the kernel's firewire-ohci, in shades of grey. A thread takes
 * them from the library; the step copies the newest. The block is a plug-in, so that robots without such a camera need
 * no libdc1394.
 *
 * Failure: The flag is 0 once no image came for `timeout`, and while the camera is not there. While the flag is 0 the
 * values stay the last good ones, and `age` grows. An image that is damaged is dropped. A camera that is missing, or
 * silent for 1 s, is opened again every second; the journal says once what is wrong.
 */
#define _GNU_SOURCE
#include "core/wall_clock.h"
#include "grabber.h"

#include <dc1394/dc1394.h>
#include <math.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { BUFFERS = 4, REOPEN_MS = 1000, SILENCE_MS = 1000 };

struct iidc {
    const char *guid;
    GRABBER_MEMBERS;
    int rate;
    double shutter;
};

#define RATES "1.875|3.75|7.5|15|30|60"

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct iidc, guid, .flags = FL_CAMERA, .default_value = "",
                 .summary =
                     "the camera's number, 16 hexadecimal digits as on its label; empty: the first that is found"),
    GRABBER_PARAMETERS(struct iidc),
    FL_PARAMETER(struct iidc, rate, .default_value = "15", .choices = RATES, .unit = "1/s",
                 .summary = "images to take; sizes that are no standard mode are taken as fast as the bus allows"),
    FL_PARAMETER(struct iidc, shutter, .default_value = "0", .min = 0, .max = 10, .unit = "s",
                 .summary = "time of exposure; 0 leaves it to the camera"),
};

/* Standard modes in shades of grey (IIDC 1.32, 3.1); any other size is cut out of format 7's mode 0. */
static const struct {
    int64_t width, height;
    dc1394video_mode_t mode;
} modes[] = {
    {640, 480, DC1394_VIDEO_MODE_640x480_MONO8},     {800, 600, DC1394_VIDEO_MODE_800x600_MONO8},
    {1024, 768, DC1394_VIDEO_MODE_1024x768_MONO8},   {1280, 960, DC1394_VIDEO_MODE_1280x960_MONO8},
    {1600, 1200, DC1394_VIDEO_MODE_1600x1200_MONO8},
};

struct session {
    dc1394_t *library;
    dc1394camera_t *camera;
};

static uint64_t guid_of(const char *text)
{
    return strtoull(text, NULL, 16);
}

static dc1394camera_t *find(dc1394_t *library, const char *guid)
{
    dc1394camera_list_t *list;
    dc1394camera_t *camera = NULL;
    if (dc1394_camera_enumerate(library, &list) != DC1394_SUCCESS)
        return NULL;
    for (uint32_t i = 0; i < list->num && !camera; i++)
        if (!*guid || list->ids[i].guid == guid_of(guid))
            camera = dc1394_camera_new(library, list->ids[i].guid);
    dc1394_camera_free_list(list);
    return camera;
}

static bool set_size(dc1394camera_t *camera, const struct iidc *set)
{
    for (size_t i = 0; i < sizeof modes / sizeof modes[0]; i++)
        if (modes[i].width == set->width && modes[i].height == set->height &&
            dc1394_video_set_mode(camera, modes[i].mode) == DC1394_SUCCESS &&
            dc1394_video_set_framerate(camera, (dc1394framerate_t)(DC1394_FRAMERATE_1_875 + set->rate)) ==
                DC1394_SUCCESS)
            return true;
    return dc1394_video_set_mode(camera, DC1394_VIDEO_MODE_FORMAT7_0) == DC1394_SUCCESS &&
           dc1394_format7_set_roi(camera, DC1394_VIDEO_MODE_FORMAT7_0, DC1394_COLOR_CODING_MONO8, DC1394_USE_MAX_AVAIL,
                                  0, 0, (int32_t)set->width, (int32_t)set->height) == DC1394_SUCCESS;
}

/* A setting that the camera does not offer is left as it is. */
static void set_shutter(dc1394camera_t *camera, double seconds)
{
    if (seconds <= 0)
        return;
    dc1394_feature_set_mode(camera, DC1394_FEATURE_SHUTTER, DC1394_FEATURE_MODE_MANUAL);
    dc1394_feature_set_absolute_control(camera, DC1394_FEATURE_SHUTTER, DC1394_ON);
    dc1394_feature_set_absolute_value(camera, DC1394_FEATURE_SHUTTER, (float)seconds);
}

static void close_session(struct session *session)
{
    if (session->camera) {
        dc1394_video_set_transmission(session->camera, DC1394_OFF);
        dc1394_capture_stop(session->camera);
        dc1394_camera_free(session->camera);
    }
    if (session->library)
        dc1394_free(session->library);
    *session = (struct session){0};
}

/* The library looks for the bus only when it is opened, so open it again each time. */
static bool open_session(struct session *session, struct grabber *grabber)
{
    const struct iidc *set = grabber->parameters;
    session->library = dc1394_new();
    session->camera = session->library ? find(session->library, set->guid) : NULL;
    if (!session->camera) {
        GRABBER_TELL(grabber, "no camera %s%son the FireWire bus; retrying", set->guid, *set->guid ? " " : "");
    } else if (dc1394_video_set_iso_speed(session->camera, DC1394_ISO_SPEED_400) != DC1394_SUCCESS ||
               !set_size(session->camera, set)) {
        GRABBER_TELL(grabber,
                     "the camera has no images of %d x %d pixels in shades of grey: set width, height and rate",
                     (int)set->width, (int)set->height);
    } else {
        set_shutter(session->camera, set->shutter);
        if (dc1394_capture_setup(session->camera, BUFFERS, DC1394_CAPTURE_FLAGS_DEFAULT) == DC1394_SUCCESS &&
            dc1394_video_set_transmission(session->camera, DC1394_ON) == DC1394_SUCCESS)
            return true;
        GRABBER_TELL(grabber, "the camera does not start: is another program or robot using it?");
    }
    close_session(session);
    return false;
}

/* The library stamps in CLOCK_REALTIME, which may be set at any time: only the frame's age is taken from it. */
static int64_t taken_ns(const dc1394video_frame_t *frame)
{
    enum { PLAUSIBLE_US = 1000 * 1000 };
    int64_t now_ns = fl_now_ns();
    int64_t age_us = (now_ns + fl_wall_less_monotonic_ns()) / 1000 - (int64_t)frame->timestamp;
    return age_us > 0 && age_us < PLAUSIBLE_US ? now_ns - age_us * 1000 : now_ns;
}

static bool fits(dc1394camera_t *camera, dc1394video_frame_t *frame, const struct iidc *set)
{
    return !dc1394_capture_is_frame_corrupt(camera, frame) && frame->size[0] == set->width &&
           frame->size[1] == set->height && frame->color_coding == DC1394_COLOR_CODING_MONO8 &&
           frame->stride >= frame->size[0];
}

/* Take the newest of the frames that are ready; false when the camera is gone. */
static bool take(dc1394camera_t *camera, struct grabber *grabber)
{
    const struct iidc *set = grabber->parameters;
    dc1394video_frame_t *newest = NULL;
    for (int taken = 0; taken < BUFFERS; taken++) {
        dc1394video_frame_t *frame = NULL;
        if (dc1394_capture_dequeue(camera, DC1394_CAPTURE_POLICY_POLL, &frame) != DC1394_SUCCESS)
            return false;
        if (!frame)
            break;
        bool usable = fits(camera, frame, set);
        if (!usable)
            GRABBER_TELL(grabber, "an image is damaged, or of another size: check the cable");
        dc1394video_frame_t *older = usable ? newest : frame;
        if (older && dc1394_capture_enqueue(camera, older) != DC1394_SUCCESS)
            return false;
        grabber->published += usable && newest;
        newest = usable ? frame : newest;
    }
    if (!newest)
        return true;
    uint8_t *to = grabber_pixels(grabber);
    for (size_t row = 0; row < newest->size[1]; row++)
        memcpy(to + row * newest->size[0], newest->image + row * newest->stride, newest->size[0]);
    grabber_publish(grabber, taken_ns(newest));
    return dc1394_capture_enqueue(camera, newest) == DC1394_SUCCESS;
}

static void run(struct fl_driver *driver, void *context)
{
    struct grabber *grabber = context;
    struct session session = {0};
    do {
        if (!open_session(&session, grabber))
            continue;
        atomic_store(&grabber->connected, true);
        int fd = dc1394_capture_get_fileno(session.camera);
        int ready;
        while ((ready = fl_driver_wait(driver, fd, false, SILENCE_MS)) == 1 && take(session.camera, grabber))
            ;
        atomic_store(&grabber->connected, false);
        if (ready == 0)
            GRABBER_TELL(grabber, "no image for %d ms; restarting it", SILENCE_MS);
        else if (ready != -1)
            GRABBER_TELL(grabber, "the camera is gone; retrying");
        close_session(&session);
    } while (fl_driver_wait(driver, -1, false, REOPEN_MS) == 0);
}

static int configure(struct fl_block *block)
{
    const struct iidc *set = block->parameters;
    char *end;
    strtoull(set->guid, &end, 16);
    if (*set->guid && (*end || strlen(set->guid) != 16))
        return fl_fail(block, "guid %s is not 16 hexadecimal digits", set->guid);
    return grabber_configure(block, set->width, set->height);
}

static int start(struct fl_block *block)
{
    const struct iidc *set = block->parameters;
    /* The library would write to the standard error while it looks for a camera that is not there yet. */
    dc1394_log_register_handler(DC1394_LOG_ERROR, NULL, NULL);
    dc1394_log_register_handler(DC1394_LOG_WARNING, NULL, NULL);
    return grabber_start(block, block->state, set->width, set->height, run);
}

static int step(struct fl_block *block)
{
    const struct iidc *set = block->parameters;
    grabber_step(block, block->state, set->timeout);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    grabber_stop(block->state);
}

FL_BLOCK(frame_grabber_iidc) = {
    .abi = FL_ABI,
    .name = "frame-grabber-iidc",
    .summary = "images of a FireWire camera (IIDC), in shades of grey",
    .source = "1394 Trade Association, IIDC 1394-based Digital Camera Specification 1.32; libdc1394 2.2",
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct iidc),
    .state_size = sizeof(struct grabber),
    .configure = configure,
    .start = start,
    .step = step,
    .terminate = terminate,
};
