/* The triple buffer; apart from the cameras' tests, so that ThreadSanitizer can watch it. */
#include "blocks/camera/frames.h"

#include "testbed.h"

#include <pthread.h>

enum { RECORDS = 100 * 1000, BYTES = 256 };
static struct frames frames;

static void *produce(void *unused)
{
    (void)unused;
    for (uint32_t i = 1; i <= RECORDS; i++) {
        memset(frames_back(&frames), (int)(i & 0xFF), BYTES);
        frames_publish(&frames, i);
    }
    return NULL;
}

static void leaves_alone_what_is_read(void **state)
{
    (void)state;
    static uint8_t memory[3][BYTES];
    frames = (struct frames){.reading = 1, .between = 2};
    for (int i = 0; i < 3; i++)
        frames.buffers[i].pixels = memory[i];
    frames_back(&frames)[0] = 1;
    frames_publish(&frames, 1);
    const struct frame *frame = frames_newest(&frames);
    for (uint8_t i = 2; i < 8; i++) {
        frames_back(&frames)[0] = i;
        frames_publish(&frames, i);
        assert_int_equal(frame->pixels[0], 1);
        assert_int_equal(frame->sequence, 1);
    }
    assert_int_equal(frames_newest(&frames)->pixels[0], 7);
}

/* No frame is seen half, twice or out of order, and the last one arrives. */
static void hands_frames_over(void **state)
{
    (void)state;
    static uint8_t memory[3][BYTES];
    pthread_t producer;
    frames = (struct frames){.reading = 1, .between = 2};
    for (int i = 0; i < 3; i++)
        frames.buffers[i].pixels = memory[i];
    assert_null(frames_newest(&frames));
    assert_int_equal(pthread_create(&producer, NULL, produce, NULL), 0);
    for (uint32_t last = 0; last < RECORDS;) {
        const struct frame *frame = frames_newest(&frames);
        if (!frame)
            continue;
        assert_true(frame->sequence > last);
        last = frame->sequence;
        assert_int_equal(frame->at_ns, last);
        for (int i = 0; i < BYTES; i++)
            assert_int_equal(frame->pixels[i], (uint8_t)last);
    }
    assert_null(frames_newest(&frames));
    pthread_join(producer, NULL);
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(leaves_alone_what_is_read),
                                       cmocka_unit_test(hands_frames_over)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
