/* The grabber against a libdc1394 that is dc1394_bus.c. */
#define _GNU_SOURCE
#include "dc1394_bus.h"
#include "said.h"
#include "seccomp.h"
#include "testbed.h"

#include <time.h>

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
    for (int i = 0; i < BUS_BUFFERS; i++)
        if (bus.buffers[i].full)
            return false;
    return true;
}

static int looked;

static bool looked_again(void)
{
    return bus.looked > looked + 1;
}

static void draw(uint8_t first)
{
    for (int row = 0; row < HEIGHT; row++)
        for (int column = 0; column < STRIDE; column++)
            bus.image[row * STRIDE + column] = (uint8_t)(column < WIDTH ? first + column + row : 0xEE);
}

static void expose(uint8_t first, int64_t age_ms)
{
    draw(first);
    bus_expose(age_ms);
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

static struct fl_block *looking;
static uint8_t seen[BUS_BUFFERS];
static size_t seen_count;

static void look_then(void)
{
    testbed_step(looking);
    seen[seen_count++] = *(const uint8_t *)testbed_output(looking, "image");
}

/* Frames that wait for the thread: no step gets an older one. Seen to fail: steps saw 10, then 20, then 30. */
static void passes_over_all_but_the_newest(void **state)
{
    (void)state;
    bus.present = true;
    looking = grabber(NULL, NULL);
    await(transmits);
    LOCKED({
        bus.given_back = look_then;
        for (uint8_t first = 10; first <= 10 * BUS_BUFFERS; first = (uint8_t)(first + 10)) {
            draw(first);
            bus_fill(0);
        }
    });
    await(taken);
    bus.given_back = NULL;
    assert_int_equal(seen_count, BUS_BUFFERS);
    for (size_t i = 0; i < seen_count; i++)
        assert_int_equal(seen[i], i + 1 < seen_count ? 0 : 10 * BUS_BUFFERS);
    assert_int_equal(GET(looking, "sequence", uint32_t), BUS_BUFFERS);
    assert_int_equal(bus.lost, 0);
    testbed_end(looking);
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
    struct said said = said_begin();
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
    bus_unplug();
    await(looked_again);
    look(block);
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    testbed_end(block);
    assert_int_equal(said_times(&said, "no camera on the FireWire bus; retrying"), 1);
    assert_int_equal(said_times(&said, "the camera is gone; retrying"), 1);
    said_end(&said);
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
        cmocka_unit_test(passes_over_all_but_the_newest),
        cmocka_unit_test(grabs),
        cmocka_unit_test(waits_for_its_camera),
        cmocka_unit_test(cuts_other_sizes_out),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
