#define _GNU_SOURCE
#include "testbed.h"

#include <math.h>
#include <stdlib.h>

/* The floating robot's: four opposing pairs of 0.16 N, each 0.1 m beside the centre of mass. */
#define POSITIONS  "-0.2,0.1,-0.2,-0.1,0.2,0.1,0.2,-0.1,0.1,-0.2,-0.1,-0.2,0.1,0.2,-0.1,0.2"
#define DIRECTIONS "1,0,1,0,-1,0,-1,0,0,1,0,1,0,-1,0,-1"
#define GEOMETRY   "positions", POSITIONS, "directions", DIRECTIONS, "force", "0.16"

enum { THRUSTERS = 8 };

static const double force = 0.16, arm = 0.1;
static const double rows[THRUSTERS][3] = {{1, 0, -1}, {1, 0, 1},  {-1, 0, 1},  {-1, 0, -1},
                                          {0, 1, 1},  {0, 1, -1}, {0, -1, -1}, {0, -1, 1}};

static void command(struct fl_block *mapping, double x, double y, double torque)
{
    SET(mapping, "force_x", double, x);
    SET(mapping, "force_y", double, y);
    SET(mapping, "torque", double, torque);
    assert_int_equal(testbed_step(mapping), FL_OK);
}

/* Force and torque of the on-times, by the rows above; and their total as a duty. */
static double made(struct fl_block *mapping, double period, double total[3])
{
    const double *on_time = testbed_output(mapping, "on_time");
    double sum = 0;
    memset(total, 0, 3 * sizeof *total);
    for (int i = 0; i < THRUSTERS; i++) {
        assert_true(on_time[i] >= 0 && on_time[i] <= period * (1 + 1e-12));
        sum += on_time[i] / period;
        for (int axis = 0; axis < 3; axis++)
            total[axis] += on_time[i] / period * force * rows[i][axis] * (axis == 2 ? arm : 1);
    }
    return sum;
}

/* So many steps that rounding to whole ones hardly shows: each command of its own block. */
static double allocated(double x, double y, double torque, double total[3], bool *saturated)
{
    struct fl_block *mapping = testbed_block("thruster-mapping", GEOMETRY, "steps", "1000000", NULL);
    testbed_begin(mapping);
    command(mapping, x, y, torque);
    *saturated = GET(mapping, "saturated", uint8_t);
    double sum = made(mapping, 1e4, total);
    const double *achieved = testbed_output(mapping, "achieved");
    for (int axis = 0; axis < 3; axis++)
        assert_near(achieved[axis], total[axis], 1e-12);
    testbed_end(mapping);
    return sum;
}

/* For this geometry the programme's dual has a closed form: the least total is max(|x| + |y|, |torque| / arm) / force.
 */
static void makes_the_command_with_the_least_on_time(void **state)
{
    (void)state;
    unsigned seed = 1;
    double total[3];
    bool saturated;
    for (int i = 0; i < 300; i++) {
        double x = 0.16 * (2.0 * rand_r(&seed) / RAND_MAX - 1), y = 0.16 * (2.0 * rand_r(&seed) / RAND_MAX - 1);
        double torque = 0.016 * (2.0 * rand_r(&seed) / RAND_MAX - 1);
        if (i % 7 == 0)
            x = 0;
        if (i % 5 == 0)
            y = 0;
        if (i % 3 == 0)
            torque = 0;
        double sum = allocated(x, y, torque, total, &saturated);
        assert_false(saturated); /* with all of them these thrusters make each of these */
        assert_near(total[0], x, 1e-6);
        assert_near(total[1], y, 1e-6);
        assert_near(total[2], torque, 1e-7);
        assert_near(sum, fmax(fabs(x) + fabs(y), fabs(torque) / arm) / force, 1e-5);
    }
}

/* What needs more than three thrusters. */
static void uses_all_that_it_takes(void **state)
{
    (void)state;
    static const double commands[][3] = {{0.32, 0.32, 0}, {0, 0, 0.064}, {-0.32, 0, 0.032}, {0.32, 0.32, 1e-9}};
    double total[3];
    bool saturated;
    for (size_t i = 0; i < sizeof commands / sizeof commands[0]; i++) {
        allocated(commands[i][0], commands[i][1], commands[i][2], total, &saturated);
        assert_int_equal(saturated, i == 3); /* which leaves nothing to turn with */
        for (int axis = 0; axis < 3; axis++)
            assert_near(total[axis], commands[i][axis], 1e-6);
    }
}

static void uses_both_of_a_pair(void **state)
{
    (void)state;
    struct fl_block *mapping = testbed_block("thruster-mapping", GEOMETRY, "steps", "10", NULL);
    struct fl_block *other = testbed_block("thruster-mapping", GEOMETRY, "steps", "10", NULL);
    testbed_begin(mapping);
    testbed_begin(other);
    command(mapping, 0.16, 0, 0);
    command(other, 0, 0, -0.016);
    const double *on_time = testbed_output(mapping, "on_time"), *turning = testbed_output(other, "on_time");
    for (int i = 0; i < THRUSTERS; i++)
        assert_near(on_time[i], i < 2 ? 0.05 : 0, 1e-12);
    double sum = 0;
    for (int i = 0; i < THRUSTERS; i++) {
        sum += turning[i];
        assert_true(rows[i][2] < 0 || turning[i] < 1e-12);
    }
    assert_near(sum, 0.1, 1e-12);
    testbed_end(mapping);
    testbed_end(other);
}

/* More than there is: the direction stays, and the greatest duty is 1. */
static void saturates_in_the_direction(void **state)
{
    (void)state;
    static const double commands[][3] = {{0.5, 0.4, 0.02}, {-3, 0, 0}, {0, 0, 1}, {1e20, -1e20, 0}};
    double total[3];
    bool saturated;
    for (size_t i = 0; i < sizeof commands / sizeof commands[0]; i++) {
        const double *wanted = commands[i];
        allocated(wanted[0], wanted[1], wanted[2], total, &saturated);
        assert_true(saturated);
        double scale = 0;
        for (int axis = 0; axis < 3; axis++)
            scale = fmax(scale, fabs(total[axis]) / fmax(fabs(wanted[axis]), 1e-300));
        assert_true(scale > 0 && scale < 1);
        for (int axis = 0; axis < 3; axis++)
            assert_near(total[axis], scale * wanted[axis], 1e-6);
    }
    allocated(-3, 0, 0, total, &saturated);
    assert_near(total[0], -0.32, 1e-6); /* both thrusters of the side, all the time */
    allocated(0.3, 0, 0, total, &saturated);
    assert_false(saturated);
    /* Half of it is all that two sides have. */
    allocated(0.64, 0.64, 0, total, &saturated);
    assert_near(total[0], 0.32, 1e-6);
    assert_near(total[1], 0.32, 1e-6);
}

/* Over the control periods a thruster is on for what was commanded, whatever a period can make of it; and what is not
 * commanded opens no valve. */
static void carries_the_rounding_over(void **state)
{
    (void)state;
    static const struct {
        const char *steps, *minimum;
        double most; /* steps that may be owed */
    } cases[] = {{"1", "0", 0.5}, {"3", "0", 0.5}, {"10", "0.05", 2.5}};
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        struct fl_block *mapping =
            testbed_block("thruster-mapping", GEOMETRY, "steps", cases[i].steps, "minimum", cases[i].minimum, NULL);
        int steps = atoi(cases[i].steps);
        unsigned seed = 1;
        const double *on_time = testbed_output(mapping, "on_time");
        double wanted = 0, on = 0;
        testbed_begin(mapping);
        for (int period = 0; period < 1000; period++) {
            /* Sometimes nothing, sometimes more than there is. */
            double force_x = fmax(fmin(1.2 * rand_r(&seed) / RAND_MAX - 0.1, 1), 0);
            for (int n = 0; n < steps; n++)
                command(mapping, 0.32 * force_x, 0, 0);
            wanted += force_x * steps;
            on += on_time[0] / 0.01;
            assert_near(on, wanted, cases[i].most + 1e-6);
            assert_near(on_time[1], on_time[0], 1e-12);
            for (int other = 2; other < THRUSTERS; other++)
                assert_near(on_time[other], 0, 1e-12);
            if (force_x == 0)
                assert_near(on_time[0], 0, 1e-12);
        }
        testbed_end(mapping);
    }
}

/* A pair that the rounding tears apart turns the robot for one period only. */
static void makes_the_mean_of_what_one_step_cannot(void **state)
{
    (void)state;
    struct fl_block *mapping = testbed_block("thruster-mapping", GEOMETRY, "steps", "1", NULL);
    const double *achieved = testbed_output(mapping, "achieved");
    double total[3] = {0};
    testbed_begin(mapping);
    for (int n = 0; n < 1000; n++) {
        command(mapping, 0.16, 0.16, 0.008);
        assert_false(GET(mapping, "saturated", uint8_t));
        for (int axis = 0; axis < 3; axis++)
            total[axis] += achieved[axis] / 1000;
    }
    assert_near(total[0], 0.16, 1e-3);
    assert_near(total[1], 0.16, 1e-3);
    assert_near(total[2], 0.008, 1e-4);
    testbed_end(mapping);
}

/* It owes nothing for a time in which it rested without a command. */
static void forgets_what_it_owes_where_it_rests(void **state)
{
    (void)state;
    struct fl_block *mapping = testbed_block("thruster-mapping", GEOMETRY, "steps", "1", NULL);
    const uint8_t *valves = testbed_output(mapping, "valves");
    testbed_begin(mapping);
    command(mapping, 0.4 * 0.32, 0, 0);
    assert_int_equal(valves[0], 0);
    command(mapping, NAN, 0, 0);
    command(mapping, 0.4 * 0.32, 0, 0);
    assert_int_equal(valves[0], 0);
    command(mapping, 0.4 * 0.32, 0, 0);
    assert_int_equal(valves[0], 1);
    testbed_end(mapping);
}

/* Ahead push one thruster, and two at 20 degrees beside it. The one takes the least on-time, and the others
 * add what it has not. */
static void adds_what_one_thruster_has_not(void **state)
{
    (void)state;
    static const double cosine = 0.93969262078590838; /* of 20 degrees */
    struct fl_block *mapping =
        testbed_block("thruster-mapping", "steps", "1000", "force", "1", "positions",
                      "-1,0,-0.93969262078590838,-0.34202014332566873,-0.93969262078590838,0.34202014332566873,"
                      "1,0.5,1,-0.5,0,-1,0,1",
                      "directions",
                      "1,0,0.93969262078590838,0.34202014332566873,0.93969262078590838,-0.34202014332566873,"
                      "-1,0,-1,0,0,1,0,-1",
                      NULL);
    const double *achieved = testbed_output(mapping, "achieved"), *on_time = testbed_output(mapping, "on_time");
    testbed_begin(mapping);
    command(mapping, 0.9, 0, 0);
    assert_near(on_time[0], 9, 1e-9);
    for (int i = 1; i < 1000; i++)
        testbed_step(mapping);
    command(mapping, 1.2, 0, 0);
    assert_near(on_time[0], 10, 1e-9);
    assert_near(on_time[1], 10 * 0.1 / cosine, 0.005);
    assert_near(on_time[2], 10 * 0.1 / cosine, 0.005);
    assert_near(achieved[0], 1.2, 1e-3);
    assert_false(GET(mapping, "saturated", uint8_t));
    testbed_end(mapping);
}

/* Pulses at the beginning of a control period of ten steps; a command within it waits for the next. */
static void pulses(void **state)
{
    (void)state;
    struct fl_block *mapping = testbed_block("thruster-mapping", GEOMETRY, "steps", "10", NULL);
    const uint8_t *valves = testbed_output(mapping, "valves");
    testbed_begin(mapping);
    for (int period = 0; period < 3; period++) {
        for (int i = 0; i < 10; i++) {
            /* 0.096 N: 0.3 of each of the two; elsewhere in the period something else */
            command(mapping, i ? -1 : 0.096, 0, 0);
            for (int thruster = 0; thruster < THRUSTERS; thruster++)
                assert_int_equal(valves[thruster], thruster < 2 && i < 3);
        }
    }
    testbed_end(mapping);
}

/* Of 25 ms with steps of 10 ms: 3 steps, from 1.5 wanted ones. */
static void keeps_the_minimum(void **state)
{
    (void)state;
    static const struct {
        double steps, on;
    } cases[] = {{1.4, 0}, {1.6, 3}, {2.9, 3}, {3.2, 3}, {4.4, 4}, {9.8, 10}, {0, 0}};
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        struct fl_block *mapping = testbed_block("thruster-mapping", GEOMETRY, "steps", "10", "minimum", "0.025", NULL);
        testbed_begin(mapping);
        command(mapping, 0, -0.32 * cases[i].steps / 10, 0);
        const double *on_time = testbed_output(mapping, "on_time");
        assert_near(on_time[6], 0.01 * cases[i].on, 1e-12);
        assert_near(on_time[7], 0.01 * cases[i].on, 1e-12);
        testbed_end(mapping);
    }
}

static void rests_without_numbers(void **state)
{
    (void)state;
    struct fl_block *mapping = testbed_block("thruster-mapping", GEOMETRY, NULL);
    const uint8_t *valves = testbed_output(mapping, "valves");
    static const uint8_t closed[THRUSTERS];
    testbed_begin(mapping);
    command(mapping, 0.32, 0, 0);
    assert_int_equal(valves[0] + valves[1], 2);
    command(mapping, NAN, 0, 0);
    assert_memory_equal(valves, closed, THRUSTERS);
    assert_true(GET(mapping, "saturated", uint8_t));
    command(mapping, 0, 0, -INFINITY);
    assert_memory_equal(valves, closed, THRUSTERS);
    command(mapping, 1.7e308, 0, 0);
    assert_memory_equal(valves, closed, THRUSTERS);
    assert_true(GET(mapping, "saturated", uint8_t));
    command(mapping, 0, 0, 0);
    assert_memory_equal(valves, closed, THRUSTERS);
    assert_false(GET(mapping, "saturated", uint8_t));
    testbed_end(mapping);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(
        strstr(testbed_refusal("thruster-mapping", "positions", "1,2,3", "directions", "1,0", "force", "1", NULL),
               "positions: 3 numbers are not x and y of 4 to 16 thrusters"));
    assert_non_null(
        strstr(testbed_refusal("thruster-mapping", "positions", POSITIONS, "directions", "1,0", "force", "1", NULL),
               "directions: 2 numbers for 8 thrusters"));
    assert_non_null(strstr(
        testbed_refusal("thruster-mapping", "positions", POSITIONS, "directions", DIRECTIONS, "force", "1,2", NULL),
        "force: 2 numbers for 8 thrusters"));
    assert_non_null(strstr(testbed_refusal("thruster-mapping", GEOMETRY, "steps", "2", "minimum", "0.03", NULL),
                           "minimum 0.03 s is longer than a control period of 0.02 s"));
    /* All four push ahead. */
    assert_non_null(strstr(testbed_refusal("thruster-mapping", "positions", "0,1,0,2,0,-1,0,-2", "directions",
                                           "1,0,1,1,1,-1,1,0", "force", "1", NULL),
                           "cannot make a negative force_x alone"));
    /* All through the centre of mass; and all along one line. */
    assert_non_null(strstr(testbed_refusal("thruster-mapping", "positions", "-1,0,1,0,0,-1,0,1", "directions",
                                           "1,0,-1,0,0,1,0,-1", "force", "1", NULL),
                           "cannot make a negative torque alone"));
    assert_non_null(strstr(testbed_refusal("thruster-mapping", "positions", "-1,0,1,0,-2,0,2,0", "directions",
                                           "1,0,-1,0,1,0,-1,0", "force", "1", NULL),
                           "all push along one line"));
    assert_non_null(strstr(testbed_refusal("thruster-mapping", "positions", "0,1,0,2,0,-1,0,-2", "directions",
                                           "1,0,0,0,1,-1,1,0", "force", "1", NULL),
                           "thruster 1 pushes nowhere"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(makes_the_command_with_the_least_on_time),
        cmocka_unit_test(uses_all_that_it_takes),
        cmocka_unit_test(uses_both_of_a_pair),
        cmocka_unit_test(saturates_in_the_direction),
        cmocka_unit_test(adds_what_one_thruster_has_not),
        cmocka_unit_test(carries_the_rounding_over),
        cmocka_unit_test(makes_the_mean_of_what_one_step_cannot),
        cmocka_unit_test(forgets_what_it_owes_where_it_rests),
        cmocka_unit_test(pulses),
        cmocka_unit_test(keeps_the_minimum),
        cmocka_unit_test(rests_without_numbers),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
