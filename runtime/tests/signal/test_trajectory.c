#include "testbed.h"

#include <math.h>
#include <stdlib.h>

/* One step at `time` after the first, which must be done already or be this one with time 0. */
static void at(struct fl_block *block, int64_t begin_ns, double time)
{
    block->release_ns = begin_ns + llround(time * 1e9) - block->period_ns;
    assert_int_equal(testbed_step(block), FL_OK);
}

static void expect(struct fl_block *block, const char *port, double x, double y, double tolerance)
{
    const double *out = testbed_output(block, port);
    assert_near(out[0], x, tolerance);
    assert_near(out[1], y, tolerance);
}

/* A square of 1 m at 1 cm/s: each side takes 100 s. */
static void flies_the_square(void **state)
{
    (void)state;
    struct fl_block *block =
        testbed_block("trajectory", "dimensions", "2", "waypoints", "0,0,1,0,1,1,0,1,0,0", "speed", "0.01", NULL);
    testbed_begin(block);
    expect(block, "position", 0, 0, 0);
    int64_t begin_ns = block->release_ns;
    for (int i = 0; i < 40000; i++) {
        double time = 0.01 * i, along = fmod(time, 100) / 100;
        const double corners[][2] = {{0, 0}, {1, 0}, {1, 1}, {0, 1}, {0, 0}};
        const double *from = corners[i / 10000], *to = corners[i / 10000 + 1];
        at(block, begin_ns, time);
        expect(block, "position", from[0] + along * (to[0] - from[0]), from[1] + along * (to[1] - from[1]), 1e-9);
        expect(block, "velocity", 0.01 * (to[0] - from[0]), 0.01 * (to[1] - from[1]), 1e-12);
        assert_false(GET(block, "done", uint8_t));
    }
    for (int i = 0; i < 3; i++) {
        at(block, begin_ns, 400 + 1000 * i);
        expect(block, "position", 0, 0, 0);
        expect(block, "velocity", 0, 0, 0);
        assert_true(GET(block, "done", uint8_t));
    }
    testbed_end(block);
}

/* One that begins later is where the first one is, whatever its input says afterwards. */
static void joins_another(void **state)
{
    (void)state;
    const char *const late[] = {"0", "150", "-3", "nan", "1e300"};
    const double x[] = {0, 1, 0, 0, 0}, y[] = {0, 0.5, 0, 0, 0};
    for (size_t i = 0; i < sizeof late / sizeof late[0]; i++) {
        struct fl_block *block =
            testbed_block("trajectory", "dimensions", "2", "waypoints", "0,0,1,0,1,1,0,1,0,0", "speed", "0.01", NULL);
        testbed_begin(block);
        SET(block, "reset", uint8_t, 1);
        SET(block, "elapsed", double, 42);
        at(block, 0, 0);
        expect(block, "position", 0, 0, 0);
        SET(block, "reset", uint8_t, 0);
        SET(block, "elapsed", double, strtod(late[i], NULL));
        at(block, 0, 5);
        expect(block, "position", x[i], y[i], 1e-9);
        SET(block, "elapsed", double, 7);
        at(block, 0, 15);
        expect(block, "position", x[i] + (x[i] > 0 ? 0 : 0.1), y[i] + (x[i] > 0 ? 0.1 : 0), 1e-9);
        testbed_end(block);
    }
}

/* A polynomial's derivatives agree with differences of its values, it rests at both ends, and is half-way at half-time;
 * at a quarter of the time 3t² - 2t³ is 5/32, and 10t³ - 15t⁴ + 6t⁵ is 53/512. */
static void is_smooth(void **state)
{
    (void)state;
    static const struct {
        const char *interpolation;
        double quarter, peak, jerk;
    } cases[] = {{"cubic", 5.0 / 32, 1.5, 12}, {"quintic", 53.0 / 512, 1.875, 60}};
    for (size_t c = 0; c < 2; c++) {
        struct fl_block *block = testbed_block("trajectory", "waypoints", "2,6", "times", "1,3", "interpolation",
                                               cases[c].interpolation, NULL);
        testbed_begin(block);
        int64_t begin_ns = block->release_ns;
        double before[2] = {2, 0};
        at(block, begin_ns, 0);
        for (int i = 0; i <= 2000; i++) {
            at(block, begin_ns, 1 + 0.001 * i);
            double position = GET(block, "position", double), velocity = GET(block, "velocity", double);
            double acceleration = GET(block, "acceleration", double);
            if (i && i < 2000) { /* trapezoids: wrong by at most h³/12 of the jerk */
                assert_near(position - before[0], 0.0005 * (velocity + before[1]),
                            4 * cases[c].jerk / 8 * 1.01e-9 / 12);
            }
            if (i == 0 || i == 2000)
                assert_near(velocity, 0, 1e-12);
            if (i == 500)
                assert_near(position, 2 + 4 * cases[c].quarter, 1e-12);
            if (i == 1000) {
                assert_near(position, 4, 1e-12);
                assert_near(velocity, 2 * cases[c].peak, 1e-12);
                assert_near(acceleration, 0, 1e-9);
            }
            if (i == 1 && c == 1)
                assert_near(acceleration, 0, 0.1); /* the quintic's begins at zero, the cubic's does not */
            if (i == 1 && c == 0)
                assert_near(acceleration, 6, 0.1);
            before[0] = position;
            before[1] = velocity;
        }
        testbed_end(block);
    }
}

static void waits_for_its_time(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("trajectory", "waypoints", "5,7", "times", "2,4", NULL);
    testbed_begin(block);
    int64_t begin_ns = block->release_ns;
    at(block, begin_ns, 0);
    assert_near(GET(block, "position", double), 5, 0);
    assert_near(GET(block, "velocity", double), 0, 0);
    at(block, begin_ns, 1.99);
    assert_near(GET(block, "position", double), 5, 0);
    at(block, begin_ns, 3);
    assert_near(GET(block, "position", double), 6, 1e-9);
    assert_near(GET(block, "velocity", double), 1, 1e-9);
    testbed_end(block);
}

static void begins_anew_after_a_reset(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("trajectory", "waypoints", "0,1", "speed", "1", NULL);
    struct fl_block *other = testbed_block("trajectory", "waypoints", "3", NULL); /* a single point */
    testbed_begin(block);
    testbed_begin(other);
    for (int i = 0; i < 51; i++)
        testbed_step(block);
    assert_near(GET(block, "position", double), 0.5, 1e-9);
    SET(block, "reset", uint8_t, 1);
    for (int i = 0; i < 10; i++)
        testbed_step(block);
    assert_near(GET(block, "position", double), 0, 0);
    SET(block, "reset", uint8_t, 0);
    for (int i = 0; i < 26; i++)
        testbed_step(block);
    assert_near(GET(block, "position", double), 0.25, 1e-9);
    testbed_step(other);
    assert_near(GET(other, "position", double), 3, 0);
    assert_true(GET(other, "done", uint8_t));
    testbed_end(block);
    testbed_end(other);
}

/* With a speed, points that are the same take no time. */
static void passes_equal_points(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("trajectory", "waypoints", "0,1,1,0", "speed", "1", NULL);
    testbed_begin(block);
    int64_t begin_ns = block->release_ns;
    at(block, begin_ns, 0);
    at(block, begin_ns, 1);
    assert_near(GET(block, "position", double), 1, 0);
    at(block, begin_ns, 1.5);
    assert_near(GET(block, "position", double), 0.5, 1e-9);
    assert_near(GET(block, "velocity", double), -1, 1e-9);
    testbed_end(block);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("trajectory", "waypoints", "1,2,3", "dimensions", "2", "speed", "1", NULL),
                           "3 numbers are not points of 2 coordinates"));
    assert_non_null(strstr(testbed_refusal("trajectory", "waypoints", "1,2", NULL), "give either times or speed"));
    assert_non_null(strstr(testbed_refusal("trajectory", "waypoints", "1,2", "times", "0,1", "speed", "1", NULL),
                           "give either times or speed"));
    assert_non_null(
        strstr(testbed_refusal("trajectory", "waypoints", "1,2", "times", "0,1,2", NULL), "3 times for 2 waypoints"));
    assert_non_null(
        strstr(testbed_refusal("trajectory", "waypoints", "1,2,3", "times", "0,2,2", NULL), "times: 2 is not after 2"));
    assert_non_null(
        strstr(testbed_refusal("trajectory", "waypoints", "1,2", "times", "-1,2", NULL), "outside 0 to inf"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(flies_the_square),
        cmocka_unit_test(is_smooth),
        cmocka_unit_test(joins_another),
        cmocka_unit_test(waits_for_its_time),
        cmocka_unit_test(begins_anew_after_a_reset),
        cmocka_unit_test(passes_equal_points),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
