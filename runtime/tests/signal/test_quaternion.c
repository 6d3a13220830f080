#include "testbed.h"

#include <math.h>

static const double right = 1.5707963267948966;

static void turn(struct fl_block *block, double roll, double pitch, double yaw)
{
    SET(block, "roll", double, roll);
    SET(block, "pitch", double, pitch);
    SET(block, "yaw", double, yaw);
    assert_int_equal(testbed_step(block), FL_OK);
}

/* The vector by the quaternion: v + 2·q × (q × v + w·v). */
static void rotated(const double q[4], const double v[3], double out[3])
{
    double inner[3];
    for (int i = 0; i < 3; i++)
        inner[i] = q[(i + 1) % 3] * v[(i + 2) % 3] - q[(i + 2) % 3] * v[(i + 1) % 3] + q[3] * v[i];
    for (int i = 0; i < 3; i++)
        out[i] = v[i] + 2 * (q[(i + 1) % 3] * inner[(i + 2) % 3] - q[(i + 2) % 3] * inner[(i + 1) % 3]);
}

static void expect(struct fl_block *block, double vx, double vy, double vz, double x, double y, double z)
{
    double out[3];
    rotated(testbed_output(block, "quaternion"), (const double[]){vx, vy, vz}, out);
    assert_near(out[0], x, 1e-12);
    assert_near(out[1], y, 1e-12);
    assert_near(out[2], z, 1e-12);
}

/* Seen to fail with roll and yaw exchanged, and with the signs of the second terms. */
static void turns_vectors(void **state)
{
    (void)state;
    struct fl_block *to = testbed_block("angles-to-quaternion", NULL);
    testbed_begin(to);
    turn(to, 0, 0, right);
    expect(to, 1, 0, 0, 0, 1, 0); /* what is ahead lies along y */
    turn(to, 0, right, 0);
    expect(to, 1, 0, 0, 0, 0, -1); /* nose down */
    turn(to, right, 0, 0);
    expect(to, 0, 1, 0, 0, 0, 1); /* left side up */
    turn(to, right, 0, right);
    expect(to, 0, 1, 0, 0, 0, 1); /* roll about its own axis */
    expect(to, 1, 0, 0, 0, 1, 0);
    turn(to, 0, right, right);
    expect(to, 0, 1, 0, -1, 0, 0); /* pitch about its own axis */
    turn(to, INFINITY, 0, 0);
    assert_true(isnan(((const double *)testbed_output(to, "quaternion"))[0]));
    testbed_end(to);
}

static void returns(void **state)
{
    (void)state;
    struct fl_block *to = testbed_block("angles-to-quaternion", NULL),
                    *back = testbed_block("quaternion-to-angles", NULL);
    testbed_begin(to);
    testbed_begin(back);
    for (int i = -15; i <= 15; i++) {
        double roll = 0.2 * i, pitch = 0.1 * i, yaw = -0.19 * i;
        turn(to, roll, pitch, yaw);
        const double *quaternion = testbed_output(to, "quaternion");
        for (int part = 0; part < 4; part++)
            ((double *)testbed_input(back, "quaternion"))[part] = 3 * quaternion[part]; /* of any length */
        assert_int_equal(testbed_step(back), FL_OK);
        assert_near(GET(back, "roll", double), roll, 1e-9);
        assert_near(GET(back, "pitch", double), pitch, 1e-9);
        assert_near(GET(back, "yaw", double), yaw, 1e-9);
    }
    const double none[4] = {0};
    memcpy(testbed_input(back, "quaternion"), none, sizeof none);
    assert_int_equal(testbed_step(back), FL_OK);
    assert_true(isnan(GET(back, "roll", double)) && isnan(GET(back, "pitch", double)) &&
                isnan(GET(back, "yaw", double)));
    testbed_end(to);
    testbed_end(back);
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(turns_vectors), cmocka_unit_test(returns)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
