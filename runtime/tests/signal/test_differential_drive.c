#include "testbed.h"

#include <math.h>

static const double pi = 3.14159265358979323846;

static void drive(struct fl_block *block, double v, double omega)
{
    SET(block, "v", double, v);
    SET(block, "omega", double, omega);
    assert_int_equal(testbed_step(block), FL_OK);
}

static void turns_the_wheels(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("differential-drive", "radius", "0.1", "track", "0.4", NULL);
    testbed_begin(block);
    drive(block, 0.5, 0);
    assert_near(GET(block, "left", double), 5, 1e-12);
    assert_near(GET(block, "right", double), 5, 1e-12);
    drive(block, 0, 1); /* anticlockwise: the right wheel ahead */
    assert_near(GET(block, "left", double), -2, 1e-12);
    assert_near(GET(block, "right", double), 2, 1e-12);
    assert_false(GET(block, "limited", uint8_t));
    drive(block, NAN, 1);
    assert_near(GET(block, "left", double), 0, 0);
    assert_near(GET(block, "right", double), 0, 0);
    assert_true(GET(block, "limited", uint8_t));
    testbed_end(block);
}

/* v / omega, the radius of the curve, stays. */
static void slows_down_on_the_curve(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("differential-drive", "radius", "0.1", "track", "0.4", "fastest", "8", NULL);
    testbed_begin(block);
    drive(block, 1.2, 2); /* 8 and 16 rad/s */
    assert_near(GET(block, "left", double), 4, 1e-12);
    assert_near(GET(block, "right", double), 8, 1e-12);
    assert_true(GET(block, "limited", uint8_t));
    drive(block, -1.2, 0);
    assert_near(GET(block, "left", double), -8, 1e-12);
    testbed_end(block);
}

static void roll(struct fl_block *odometry, double left, double right, int steps)
{
    SET(odometry, "left", double, left);
    SET(odometry, "right", double, right);
    for (int i = 0; i < steps; i++)
        assert_int_equal(testbed_step(odometry), FL_OK);
}

/* Wheels of 2 and 4 rad/s, radius 0.1 m, track 0.4 m: 0.3 m/s and 0.5 rad/s, a circle of 0.6 m. */
static void drives_a_circle(void **state)
{
    (void)state;
    struct fl_block *odometry = testbed_block("differential-odometry", "radius", "0.1", "track", "0.4", NULL);
    struct fl_block *other = testbed_block("differential-odometry", "radius", "0.1", "track", "0.4", "x", "1", "y", "2",
                                           "heading", "1.5707963267948966", NULL);
    testbed_begin(odometry);
    testbed_begin(other);
    for (int i = 1; i <= 1500; i++) {
        double angle = 0.5 * 0.01 * i;
        roll(odometry, 2, 4, 1);
        assert_near(GET(odometry, "x", double), 0.6 * sin(angle), 1e-9);
        assert_near(GET(odometry, "y", double), 0.6 * (1 - cos(angle)), 1e-9);
        assert_near(GET(odometry, "heading", double), angle, 1e-9);
    }
    assert_near(GET(odometry, "v", double), 0.3, 1e-12);
    assert_near(GET(odometry, "omega", double), 0.5, 1e-12);
    assert_near(GET(other, "x", double), 1, 0);
    roll(other, 10, 10, 100); /* straight on, along y */
    assert_near(GET(other, "x", double), 1, 1e-9);
    assert_near(GET(other, "y", double), 3, 1e-9);
    assert_near(GET(other, "heading", double), pi / 2, 0);
    testbed_end(odometry);
    testbed_end(other);
}

static void keeps_its_pose(void **state)
{
    (void)state;
    struct fl_block *odometry = testbed_block("differential-odometry", "radius", "0.1", "track", "0.4", "x", "1", NULL);
    testbed_begin(odometry);
    roll(odometry, 10, 10, 100);
    roll(odometry, NAN, 10, 5);
    assert_near(GET(odometry, "v", double), 0, 0);
    assert_near(GET(odometry, "x", double), 2, 1e-9);
    SET(odometry, "reset", uint8_t, 1);
    roll(odometry, 10, 10, 3);
    assert_near(GET(odometry, "x", double), 1, 0);
    SET(odometry, "reset", uint8_t, 0);
    roll(odometry, 10, 10, 1);
    assert_near(GET(odometry, "x", double), 1.01, 1e-12);
    testbed_end(odometry);
}

/* A full turn takes 4 pi s, in whatever steps. */
static void keeps_its_pose_in_late_steps(void **state)
{
    (void)state;
    struct fl_block *odometry = testbed_block("differential-odometry", "radius", "0.1", "track", "0.4", NULL);
    const int64_t turn_ns = llround(4e9 * pi);
    testbed_begin(odometry);
    roll(odometry, 2, 4, 1);
    for (int64_t time_ns = 10000000, next_ns = 35000000; time_ns < turn_ns; time_ns += next_ns) {
        if (next_ns > turn_ns - time_ns)
            next_ns = turn_ns - time_ns;
        assert_int_equal(testbed_step_after(odometry, next_ns), FL_OK);
    }
    assert_near(GET(odometry, "heading", double), 2 * pi, 1e-8);
    assert_near(GET(odometry, "x", double), 0, 1e-8);
    assert_near(GET(odometry, "y", double), 0, 1e-8);
    testbed_end(odometry);
}

/* Angles of two wheels; radius 0.1 m, track 0.4 m. */
static void turn_to(struct fl_block *block, double left, double right, uint8_t flag)
{
    SET(block, "left", double, left);
    SET(block, "right", double, right);
    SET(block, "flag", uint8_t, flag);
    assert_int_equal(testbed_step(block), FL_OK);
}

static struct fl_block *encoders(void)
{
    struct fl_block *block =
        testbed_block("encoder-odometry", "radius", "0.1", "track", "0.4", "fastest", "20", "y", "2", NULL);
    testbed_begin(block);
    return block;
}

static void counts_angles(void **state)
{
    (void)state;
    struct fl_block *block = encoders();
    turn_to(block, 70, -30, 1); /* where they happen to be */
    assert_near(GET(block, "v", double), 0, 0);
    for (int i = 1; i <= 1000; i++)
        turn_to(block, 70 + 0.02 * i, -30 + 0.04 * i, 1); /* 0.3 m/s, 0.5 rad/s: a circle of 0.6 m */
    assert_near(GET(block, "v", double), 0.3, 1e-9);
    assert_near(GET(block, "omega", double), 0.5, 1e-9);
    assert_near(GET(block, "heading", double), 5, 1e-9);
    assert_near(GET(block, "x", double), 0.6 * sin(5), 1e-9);
    assert_near(GET(block, "y", double), 2 + 0.6 * (1 - cos(5)), 1e-9);
    assert_int_equal(GET(block, "lost", uint32_t), 0);
    SET(block, "reset", uint8_t, 1);
    turn_to(block, 90.02, 10.04, 1);
    assert_near(GET(block, "x", double), 0, 0);
    assert_near(GET(block, "y", double), 2, 0);
    SET(block, "reset", uint8_t, 0);
    turn_to(block, 90.12, 10.14, 1); /* since the step of the reset */
    assert_near(GET(block, "x", double), 0.01, 1e-12);
    testbed_end(block);
}

static void begins_anew(void **state)
{
    (void)state;
    struct fl_block *block = encoders();
    turn_to(block, 5, 5, 0);
    turn_to(block, 5, 5, 1);
    turn_to(block, 5.1, 5.1, 1);
    assert_near(GET(block, "x", double), 0.01, 1e-12);
    assert_int_equal(GET(block, "lost", uint32_t), 0);
    turn_to(block, 0, 5.1, 1); /* the left drive counts from zero again */
    assert_near(GET(block, "v", double), 0, 0);
    assert_near(GET(block, "x", double), 0.01, 1e-12);
    assert_int_equal(GET(block, "lost", uint32_t), 1);
    turn_to(block, 0.1, 5.2, 1);
    assert_near(GET(block, "x", double), 0.02, 1e-12);
    turn_to(block, 0.2, 5.3, 0);
    turn_to(block, 0.2, NAN, 1);
    assert_near(GET(block, "v", double), 0, 0);
    assert_near(GET(block, "x", double), 0.02, 1e-12);
    assert_int_equal(GET(block, "lost", uint32_t), 1);
    turn_to(block, 0.3, 5.4, 1);
    turn_to(block, 0.4, 5.5, 1);
    assert_near(GET(block, "x", double), 0.03, 1e-12);
    assert_int_equal(GET(block, "lost", uint32_t), 2);
    testbed_end(block);
}

/* Angles with the number of their SYNC. */
static void measured(struct fl_block *block, double left, uint32_t left_sync, double right, uint32_t right_sync)
{
    SET(block, "left_sequence", uint32_t, left_sync);
    SET(block, "right_sequence", uint32_t, right_sync);
    turn_to(block, left, right, 1);
}

/* Drives that answer a step late now and then, both (3) or one of them: the motion is that of the wheels. */
static void takes_angles_of_one_sync(void **state)
{
    (void)state;
    struct fl_block *block = encoders();
    const int late[] = {0, 0, 1, 0, 0, 2, 0, 3, 0, 3, 0};
    testbed_wire(block, "left_sequence");
    testbed_wire(block, "right_sequence");
    measured(block, 0, 1, 0, 1);
    for (int i = 1; i <= 1000; i++) {
        int what = late[i % 11], left = i - (what & 1), right = i - (what >> 1);
        measured(block, 0.02 * left, (uint32_t)left + 1, 0.04 * right, (uint32_t)right + 1);
        if (i > 1) {
            assert_near(GET(block, "v", double), 0.3, 1e-9);
            assert_near(GET(block, "omega", double), 0.5, 1e-9);
        }
    }
    measured(block, 20.02, 1002, 40.04, 1002);
    assert_near(GET(block, "heading", double), 5.005, 1e-9);
    assert_near(GET(block, "x", double), 0.6 * sin(5.005), 1e-9);
    assert_int_equal(GET(block, "lost", uint32_t), 0);
    turn_to(block, 20.02, 40.04, 0);
    assert_near(GET(block, "v", double), 0, 0);
    testbed_end(block);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("differential-drive", "radius", "0", "track", "1", NULL), "0 is outside"));
    assert_non_null(strstr(testbed_refusal("differential-odometry", "radius", "1", NULL), "parameter track of"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(turns_the_wheels),
        cmocka_unit_test(slows_down_on_the_curve),
        cmocka_unit_test(drives_a_circle),
        cmocka_unit_test(keeps_its_pose),
        cmocka_unit_test(keeps_its_pose_in_late_steps),
        cmocka_unit_test(counts_angles),
        cmocka_unit_test(begins_anew),
        cmocka_unit_test(takes_angles_of_one_sync),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
