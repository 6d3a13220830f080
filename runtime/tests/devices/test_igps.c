#define _GNU_SOURCE
#include "loopback.h"
#include "said.h"

#include "blocks/devices/igps_datagram.h"
#include "core/authentication.h"

#include <math.h>

/* Y = 1.5 m (0x3ff8...), X = -2.25 m (0xc002...), least significant byte first. */
static const uint8_t little[16] = {0, 0, 0, 0, 0, 0, 0xf8, 0x3f, 0, 0, 0, 0, 0, 0, 0x02, 0xc0};
static const uint8_t big[16] = {0x3f, 0xf8, 0, 0, 0, 0, 0, 0, 0xc0, 0x02, 0, 0, 0, 0, 0, 0};

#define A_KEY  "000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f"
#define NO_KEY "ff0102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f"

/* A datagram as the iGPS computer packs it. */
static void pack(uint8_t bytes[16], double y, double x)
{
    memcpy(bytes, &y, 8);
    memcpy(bytes + 8, &x, 8);
}

static void reads_both_orders(void **state)
{
    (void)state;
    struct igps_position position = {0};
    assert_true(igps_read(little, 16, IGPS_LITTLE_ENDIAN, 10, &position));
    assert_near(position.y, 1.5, 0);
    assert_near(position.x, -2.25, 0);
    position = (struct igps_position){0};
    assert_true(igps_read(big, 16, IGPS_BIG_ENDIAN, 10, &position));
    assert_near(position.y, 1.5, 0);
    assert_near(position.x, -2.25, 0);
}

static void refuses_what_cannot_be(void **state)
{
    (void)state;
    const double bad[] = {NAN, -NAN, INFINITY, -INFINITY, 10.000001, -10.000001, 1e300};
    struct igps_position position = {7, 7};
    uint8_t bytes[17] = {0};
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
        pack(bytes, bad[i], 0);
        assert_false(igps_read(bytes, 16, IGPS_LITTLE_ENDIAN, 10, &position));
        pack(bytes, 0, bad[i]);
        assert_false(igps_read(bytes, 16, IGPS_LITTLE_ENDIAN, 10, &position));
    }
    pack(bytes, 1, 2);
    for (size_t count = 0; count <= sizeof bytes; count++)
        if (count != IGPS_BYTES)
            assert_false(igps_read(bytes, count, IGPS_LITTLE_ENDIAN, 10, &position));
    assert_near(position.x, 7, 0);
    assert_near(position.y, 7, 0);
    pack(bytes, 10, -10);
    assert_true(igps_read(bytes, 16, IGPS_LITTLE_ENDIAN, 10, &position));
}

/* Any bytes of any length: right are two numbers in range, and nothing else is. */
static void believes_what_can_be(void **state)
{
    (void)state;
    unsigned short seed[3] = {1, 2, 3};
    unsigned right = 0;
    for (int round = 0; round < 1000000; round++) {
        uint8_t bytes[32];
        double y, x;
        size_t count = round % 8 ? IGPS_BYTES : (size_t)nrand48(seed) % sizeof bytes;
        for (size_t i = 0; i < sizeof bytes; i++)
            bytes[i] = (uint8_t)(nrand48(seed) >> 8);
        /* Of random numbers few are of any sense: bring the exponents near. */
        bytes[7] = (uint8_t)((bytes[7] & 0x80) | (nrand48(seed) & 3 ? 0x40 : 0x7f));
        bytes[15] = (uint8_t)((bytes[15] & 0x80) | (nrand48(seed) & 3 ? 0x40 : 0x7f));
        memcpy(&y, bytes, 8);
        memcpy(&x, bytes + 8, 8);
        bool can_be = count == IGPS_BYTES && isfinite(x) && isfinite(y) && fabs(x) <= 1000 && fabs(y) <= 1000;
        struct igps_position position = {7e7, 7e7};
        assert_int_equal(igps_read(bytes, count, IGPS_LITTLE_ENDIAN, 1000, &position), can_be);
        assert_true(position.x == (can_be ? x : 7e7) && position.y == (can_be ? y : 7e7));
        right += can_be;
    }
    assert_in_range(right, 1000, 900000);
}

struct system {
    int fd;
    const char *port; /* of the robot */
};

static struct system a_system(void)
{
    return (struct system){bare("127.0.0.1", 0), free_port()};
}

static void send_bytes(const struct system *system, const void *bytes, size_t count)
{
    send_to(system->fd, system->port, bytes, count);
}

static void send_position(const struct system *system, double y, double x)
{
    uint8_t bytes[16];
    pack(bytes, y, x);
    send_bytes(system, bytes, sizeof bytes);
}

static void step(struct fl_block *block)
{
    block->release_ns = fl_now_ns() - block->period_ns;
    assert_int_equal(testbed_step(block), FL_OK);
}

static const double *position_of(struct fl_block *block)
{
    return testbed_output(block, "position");
}

static void follows(void **state)
{
    (void)state;
    struct system system = a_system();
    struct fl_block *igps = testbed_block("igps", "port", system.port, "range", "10", "timeout", "60", NULL);
    testbed_begin(igps);
    step(igps);
    assert_false(GET(igps, "flag", bool));
    send_bytes(&system, little, 16);
    step(igps);
    assert_true(GET(igps, "flag", bool));
    assert_near(position_of(igps)[0], -2.25, 0);
    assert_near(position_of(igps)[1], 1.5, 0);
    send_position(&system, 1, 2);
    send_position(&system, 3, 4);
    step(igps);
    assert_near(position_of(igps)[0], 4, 0);
    assert_near(position_of(igps)[1], 3, 0);
    assert_int_equal(GET(igps, "sequence", uint32_t), 3);
    close(system.fd);
    testbed_end(igps);
}

static void follows_big_endian(void **state)
{
    (void)state;
    struct system system = a_system();
    struct fl_block *igps =
        testbed_block("igps", "port", system.port, "byte_order", "big-endian", "timeout", "60", NULL);
    testbed_begin(igps);
    send_bytes(&system, big, 16);
    step(igps);
    assert_true(GET(igps, "flag", bool));
    assert_near(position_of(igps)[0], -2.25, 0);
    close(system.fd);
    testbed_end(igps);
}

static void flags_what_cannot_be(void **state)
{
    (void)state;
    struct system system = a_system();
    struct fl_block *igps = testbed_block("igps", "port", system.port, "range", "10", "timeout", "60", NULL);
    testbed_begin(igps);
    send_position(&system, 1, 2);
    send_position(&system, NAN, 2); /* does not see the robot any more */
    step(igps);
    assert_false(GET(igps, "flag", bool));
    assert_near(position_of(igps)[0], 2, 0);
    assert_int_equal(GET(igps, "sequence", uint32_t), 1);
    send_position(&system, 10.5, 2);
    step(igps);
    assert_false(GET(igps, "flag", bool));
    send_position(&system, 3, 4);
    send_bytes(&system, "not of the system", 17);
    send_bytes(&system, "", 0);
    step(igps);
    assert_true(GET(igps, "flag", bool));
    assert_near(position_of(igps)[0], 4, 0);
    assert_int_equal(GET(igps, "refused", uint32_t), 2);
    close(system.fd);
    testbed_end(igps);
}

static void flags_silence(void **state)
{
    (void)state;
    struct system system = a_system();
    struct fl_block *igps = testbed_block("igps", "port", system.port, "timeout", "60", NULL);
    testbed_begin(igps);
    send_position(&system, 1, 2);
    igps->release_ns = fl_now_ns() + 1000000 - igps->period_ns; /* an age above zero, even if stamped when read */
    testbed_step(igps);
    int64_t arrived = igps->release_ns - llround(GET(igps, "age", double) * 1e9);
    igps->release_ns = arrived + 60000000000 - igps->period_ns;
    testbed_step(igps);
    assert_true(GET(igps, "flag", bool));
    igps->release_ns = arrived + 60000000001 - igps->period_ns;
    testbed_step(igps);
    assert_false(GET(igps, "flag", bool));
    assert_near(position_of(igps)[0], 2, 0);
    send_position(&system, 1, 2);
    step(igps);
    assert_true(GET(igps, "flag", bool));
    close(system.fd);
    testbed_end(igps);
}

/* The sender is a block udp-send with the same keys; the attacker has its address and no key. */
static void takes_what_its_sender_proves(void **state)
{
    (void)state;
    static const uint8_t nothing[IGPS_BYTES + AUTHENTICATION_TRAILER];
    char directory[] = "/tmp/flotilla-igps-XXXXXX", file[64];
    assert_non_null(mkdtemp(directory));
    snprintf(file, sizeof file, "%s/message-keys", directory);
    FILE *stream = fopen(file, "we");
    assert_non_null(stream);
    assert_true(fprintf(stream, "127.0.0.1 %s %s\n127.0.0.2 %s %s\n", A_KEY, NO_KEY, NO_KEY, A_KEY) > 0);
    assert_int_equal(fclose(stream), 0);

    struct system attacker = {bare("127.0.0.2", 0), free_port()};
    struct said said = said_begin();
    struct fl_block *igps =
        testbed_block("igps", "port", attacker.port, "from", "127.0.0.2", "timeout", "60", "keys", file, NULL);
    struct fl_block *send = testbed_block("udp-send", "address", "127.0.0.1", "local_address", "127.0.0.2", "port",
                                          attacker.port, "length", "16", "keys", file, NULL);
    igps->period_ns = INT64_C(3600000000000); /* to look at what is refused has all the time that it takes */
    testbed_begin(igps);
    testbed_begin(send);
    pack(testbed_input(send, "data"), 3, 4);
    for (int i = 0; i < 3; i++) {
        testbed_step(send);
        settle();
        step(igps);
        settle();
    }
    assert_true(GET(igps, "flag", bool));
    assert_near(position_of(igps)[0], 4, 0);
    assert_near(position_of(igps)[1], 3, 0);
    assert_int_equal(GET(igps, "sequence", uint32_t), 2);
    assert_int_equal(GET(igps, "replayed", uint32_t), 1);

    send_position(&attacker, 7, 7);
    send_bytes(&attacker, nothing, sizeof nothing);
    step(igps);
    assert_near(position_of(igps)[0], 4, 0);
    assert_int_equal(GET(igps, "sequence", uint32_t), 2);
    assert_int_equal(GET(igps, "refused", uint32_t), 1);
    assert_int_equal(GET(igps, "forged", uint32_t), 1);
    assert_int_equal(said_times(&said, "igps: "), 0); /* there is a position */
    testbed_end(igps);

    igps = testbed_block("igps", "port", attacker.port, "from", "127.0.0.2", "timeout", "60", "keys", file, NULL);
    testbed_begin(igps);
    send_bytes(&attacker, nothing, sizeof nothing);
    step(igps);
    testbed_end(igps);
    assert_int_equal(said_times(&said, "what comes proves no sender"), 1);
    igps = testbed_block("igps", "port", attacker.port, "from", "127.0.0.2", "timeout", "60", "keys", file, NULL);
    testbed_begin(igps);
    send_position(&attacker, 7, 7);
    step(igps);
    testbed_end(igps);
    assert_int_equal(said_times(&said, "what comes is refused: it has not 16 bytes and 40 of a proof"), 1);
    said_end(&said);
    testbed_end(send);
    close(attacker.fd);
    unlink(file);
    rmdir(directory);
}

/* Each cause by a block of its own: what its last step saw is logged at its end. */
static void says_why_there_is_no_position(void **state)
{
    (void)state;
    struct system system = a_system();
    struct said said = said_begin();
    struct fl_block *igps = testbed_block("igps", "port", system.port, "range", "10", "timeout", "60", NULL);
    testbed_begin(igps);
    step(igps);
    testbed_end(igps);
    assert_int_equal(said_times(&said, "igps: "), 0); /* too early to tell */
    igps = testbed_block("igps", "port", system.port, "range", "10", "timeout", "60", NULL);
    testbed_begin(igps);
    step(igps);
    igps->release_ns += INT64_C(5000000001) - igps->period_ns;
    testbed_step(igps);
    testbed_end(igps);
    assert_int_equal(said_times(&said, "no position comes"), 1);
    igps = testbed_block("igps", "port", system.port, "range", "10", "timeout", "60", NULL);
    testbed_begin(igps);
    send_position(&system, NAN, 2);
    step(igps);
    testbed_end(igps);
    assert_int_equal(said_times(&said, "does not see the robot"), 1);
    igps = testbed_block("igps", "port", system.port, "range", "10", "timeout", "60", NULL);
    testbed_begin(igps);
    step(igps);
    send_bytes(&system, "not of the system", 17);
    step(igps);
    testbed_end(igps);
    assert_int_equal(said_times(&said, "what comes is refused"), 1);
    assert_int_equal(said_times(&said, "igps: "), 3);
    said_end(&said);
    close(system.fd);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("igps", "port", "5000", "byte_order", "network", NULL),
                           "network is not one of little-endian|big-endian"));
    assert_non_null(strstr(testbed_refusal("igps", "port", "5000", "range", "-1", NULL), "-1 is outside 0 to 1e+06 m"));
    assert_non_null(
        strstr(testbed_refusal("igps", "port", "5000", "from", "here", NULL), "here is not an IPv4 address"));
    assert_non_null(strstr(testbed_refusal("igps", "port", "5000", "keys", "/message-keys", NULL),
                           "parameter keys: 0.0.0.0 is many computers"));
    assert_non_null(strstr(testbed_refusal("igps", NULL), "parameter port of igps is missing"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(reads_both_orders),
        cmocka_unit_test(refuses_what_cannot_be),
        cmocka_unit_test(believes_what_can_be),
        cmocka_unit_test(follows),
        cmocka_unit_test(follows_big_endian),
        cmocka_unit_test(flags_what_cannot_be),
        cmocka_unit_test(flags_silence),
        cmocka_unit_test(takes_what_its_sender_proves),
        cmocka_unit_test(says_why_there_is_no_position),
        cmocka_unit_test(refuses),
    };
    stay_on_one_processor();
    return cmocka_run_group_tests(tests, NULL, NULL);
}
