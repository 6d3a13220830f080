/* Messages of ROS 2 from one block to the other, on loopback only. tests/runtime/test_ros.py has another implementation
 * at the other end. */
#define _GNU_SOURCE
#include "seccomp.h"
#include "testbed.h"

#include <dds/dds.h>
#include <math.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

enum { PATIENCE_MS = 20000, PERIOD_MS = 10, RANGES = 1081 };

static char domain[8]; /* of this process, so that two runs on a computer do not meet */

static void step(struct fl_block *block)
{
    block->release_ns = fl_now_ns() - block->period_ns;
    assert_int_equal(testbed_step(block), FL_OK);
}

/* Step both until the second has the first one's message. */
static bool passes(struct fl_block *from, struct fl_block *to)
{
    uint32_t before = GET(to, "sequence", uint32_t);
    for (int waited = 0; waited < PATIENCE_MS; waited += PERIOD_MS) {
        step(from);
        step(to);
        if (GET(to, "sequence", uint32_t) >= before + 3) /* what waited at the sender is past */
            return true;
        poll(NULL, 0, PERIOD_MS);
    }
    return false;
}

#define PUBLISHER(type_name, name, ...)                                                                                \
    begun(testbed_block("ros-publish", "type", type_name, "topic", name, "domain", domain, __VA_ARGS__, NULL))
#define SUBSCRIBER(type_name, name, ...)                                                                               \
    begun(testbed_block("ros-subscribe", "type", type_name, "topic", name, "domain", domain, "timeout", "30",          \
                        __VA_ARGS__, NULL))

static struct fl_block *begun(struct fl_block *block)
{
    testbed_begin(block);
    return block;
}

static void passes_a_scan(void **state)
{
    (void)state;
    struct fl_block *from = PUBLISHER("sensor_msgs/msg/LaserScan", "/robot3/scan", "frame_id", "laser", "lengths",
                                      "1081,0", "reliability", "best-effort");
    struct fl_block *to =
        SUBSCRIBER("sensor_msgs/msg/LaserScan", "robot3/scan", "frame_id", "laser", "lengths", "1081");
    struct timespec real;
    float *ranges = testbed_input(from, "ranges");
    for (int i = 0; i < RANGES; i++)
        ranges[i] = 0.25f * (float)i;
    ranges[7] = NAN;
    SET(from, "angle_increment", float, 0.25f);
    SET(from, "age", double, 1000);
    assert_true(passes(from, to));
    assert_memory_equal(testbed_output(to, "ranges"), ranges, RANGES * sizeof *ranges);
    assert_near(GET(to, "angle_increment", float), 0.25, 0);
    assert_int_equal(GET(to, "flag", uint8_t), 1);
    assert_int_equal(GET(to, "refused", uint32_t), 0);
    clock_gettime(CLOCK_REALTIME, &real);
    assert_near((double)(real.tv_sec - GET(to, "stamp", int64_t) / 1000000000), 1000, 30);
    SET(from, "age", double, NAN);
    assert_true(passes(from, to));
    assert_near((double)(real.tv_sec - GET(to, "stamp", int64_t) / 1000000000), 0, 30);
    steps_under_seccomp(from, 20);
    steps_under_seccomp(to, 5);
    testbed_end(from);
    testbed_end(to);
}

/* Another frame, or too few elements: left out. Too many: those that are there. Seen to fail without each check. */
static void takes_what_fits(void **state)
{
    (void)state;
    struct fl_block *from = PUBLISHER("sensor_msgs/msg/Joy", "joy", "frame_id", "pad", "lengths", "4,2");
    struct fl_block *less = SUBSCRIBER("sensor_msgs/msg/Joy", "joy", "lengths", "2,1");
    struct fl_block *more = SUBSCRIBER("sensor_msgs/msg/Joy", "joy", "lengths", "2,3");
    struct fl_block *other = SUBSCRIBER("sensor_msgs/msg/Joy", "joy", "lengths", "2", "frame_id", "panel");
    const float axes[4] = {0.5f, -0.5f, 1, -1};
    memcpy(testbed_input(from, "axes"), axes, sizeof axes);
    *(int32_t *)testbed_input(from, "buttons") = 1;
    for (int waited = 0; waited < PATIENCE_MS && !(GET(more, "peers", uint32_t) && GET(other, "peers", uint32_t));
         waited += PERIOD_MS) {
        step(more);
        step(other);
        poll(NULL, 0, PERIOD_MS);
    }
    assert_true(passes(from, less));
    assert_memory_equal(testbed_output(less, "axes"), axes, 2 * sizeof *axes);
    assert_int_equal(GET(less, "buttons", int32_t), 1);
    struct fl_block *refusing[] = {more, other};
    for (int i = 0; i < 2; i++) {
        for (int waited = 0; waited < PATIENCE_MS && !GET(refusing[i], "refused", uint32_t); waited += PERIOD_MS) {
            step(from);
            step(refusing[i]);
            poll(NULL, 0, PERIOD_MS);
        }
        assert_true(GET(refusing[i], "refused", uint32_t) > 0);
        assert_int_equal(GET(refusing[i], "sequence", uint32_t), 0);
    }
    testbed_end(from);
    testbed_end(less);
    testbed_end(more);
    testbed_end(other);
}

/* Types of one name match, and no others. */
static void takes_its_type_only(void **state)
{
    (void)state;
    struct fl_block *from = PUBLISHER("geometry_msgs/msg/Twist", "a", "deadline", "0");
    struct fl_block *to = SUBSCRIBER("geometry_msgs/msg/Twist", "a", "deadline", "0");
    struct fl_block *other = SUBSCRIBER("sensor_msgs/msg/Imu", "a", "deadline", "0");
    assert_true(passes(from, to));
    step(other);
    assert_int_equal(GET(to, "peers", uint32_t), 1);
    assert_int_equal(GET(other, "peers", uint32_t), 0);
    testbed_end(from);
    testbed_end(to);
    testbed_end(other);
}

static void refuses(void **state)
{
    (void)state;
    static const struct {
        const char *block, *type, *topic, *parameter, *value, *said;
    } cases[] = {
        {"ros-publish", "geometry_msgs/msg/Twist", "a", "frame_id", "map", "frame_id: the type has none: remove it"},
        {"ros-subscribe", "geometry_msgs/msg/Twist", "a", "frame_id", "map", "frame_id: the type has none: remove it"},
        {"ros-publish", "sensor_msgs/msg/Imu", "a", "location", "x", "location: the type has none: remove it"},
        {"ros-publish", "sensor_msgs/msg/Joy", "a", "deadline", "0", "lengths: the type has sequences only"},
        {"ros-publish", "sensor_msgs/msg/Joy", "a", "lengths", "1.5", "lengths: 1.5 is not a whole number"},
        {"ros-publish", "sensor_msgs/msg/Joy", "a", "lengths", "1,2,3", "lengths: has 3 numbers, and the type has 2"},
        {"ros-subscribe", "sensor_msgs/msg/LaserScan", "a", "lengths", "0,5", "lengths: ranges has no elements"},
        {"ros-publish", "geometry_msgs/msg/Twist", "cmd vel", "deadline", "0", "topic: cmd vel: is no topic of ROS"},
        {"ros-publish", "geometry_msgs/msg/Twist", "a//b", "deadline", "0", "topic: a//b: is no topic of ROS"},
        {"ros-publish", "geometry_msgs/msg/Twist", "a/", "deadline", "0", "topic: a/: is no topic of ROS"},
        {"ros-publish", "geometry_msgs/msg/Twist", "a/3", "deadline", "0", "topic: a/3: is no topic of ROS"},
    };
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        const char *said = testbed_refusal(cases[i].block, "type", cases[i].type, "topic", cases[i].topic,
                                           cases[i].parameter, cases[i].value, NULL);
        if (!strstr(said, cases[i].said))
            fail_msg("%s instead of %s", said, cases[i].said);
    }
    char name[300];
    memset(name, 'a', sizeof name - 1);
    name[sizeof name - 1] = 0;
    assert_non_null(strstr(testbed_refusal("ros-publish", "type", "geometry_msgs/msg/Twist", "topic", name, NULL),
                           "topic: has 299 characters, give at most 252"));
    assert_non_null(
        strstr(testbed_refusal("ros-publish", "type", "sensor_msgs/msg/Imu", "topic", "a", "frame_id", name, NULL),
               "frame_id: is too long"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(passes_a_scan),
        cmocka_unit_test(takes_what_fits),
        cmocka_unit_test(takes_its_type_only),
        cmocka_unit_test(refuses),
    };
    snprintf(domain, sizeof domain, "%d", 1 + getpid() % 200);
    setenv("CYCLONEDDS_URI",
           "<CycloneDDS><Domain Id=\"any\"><General>"
           "<Interfaces><NetworkInterface name=\"lo\" multicast=\"false\"/></Interfaces>"
           "<AllowMulticast>false</AllowMulticast>"
           "<MaxMessageSize>1400B</MaxMessageSize><FragmentSize>1300B</FragmentSize></General>"
           "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>4</MaxAutoParticipantIndex>"
           "<Peers><Peer Address=\"127.0.0.1\"/></Peers></Discovery></Domain></CycloneDDS>",
           1);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
