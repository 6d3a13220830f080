/* Blocks whose interface or address comes after they began, goes, and comes back, in a network namespace of the test's
 * own. The far end of the interface `radio0` is `far0`, where frames are written and read as they are. */
#define _GNU_SOURCE
#include "loopback.h"

#include "core/service.h"
#include "core/udp.h"

#include <linux/if_ether.h>
#include <linux/if_packet.h>
#include <net/if.h>
#include <poll.h>

enum { PATIENCE_MS = 20000, ROUND_MS = 10, HEADERS = 14 + 20 + 8 };

#define HERE 0x0a090001 /* 10.9.0.1 */
#define FAR  0x0a090002

static void run(const char *command)
{
    if (system(command) != 0) /* NOLINT(concurrency-mt-unsafe) */
        fail_msg("%s", command);
}

/* Returns the raw socket of its far end. */
static int plug_in(void)
{
    run("ip link add radio0 address 02:00:00:00:00:01 type veth peer name far0 address 02:00:00:00:00:02 &&"
        "ip link set radio0 arp off up && ip link set far0 arp off up && ip address add 10.9.0.1/24 dev radio0");
    int fd = socket(AF_PACKET, SOCK_RAW | SOCK_CLOEXEC | SOCK_NONBLOCK, htons(ETH_P_IP));
    const struct sockaddr_ll far = {
        .sll_family = AF_PACKET, .sll_protocol = htons(ETH_P_IP), .sll_ifindex = (int)if_nametoindex("far0")};
    assert_int_equal(bind(fd, (const struct sockaddr *)&far, sizeof far), 0);
    return fd;
}

static void unplug(int far)
{
    close(far);
    run("ip link delete radio0");
}

static void put(uint8_t *at, uint32_t value, int bytes)
{
    while (bytes--)
        *at++ = (uint8_t)(value >> 8 * bytes);
}

/* A datagram of one byte, by the far end: Ethernet, IPv4 (RFC 791), UDP without a checksum (RFC 768). */
static void send_frame(int far, uint16_t port, uint8_t byte)
{
    uint8_t frame[HEADERS + 1] = {2, 0, 0, 0, 0, 1, 2, 0, 0, 0, 0, 2, 8, 0, 0x45}, *ip = frame + 14, *udp = ip + 20;
    uint32_t sum = 0;
    put(ip + 2, 20 + 8 + 1, 2);
    put(ip + 8, 64 << 8 | IPPROTO_UDP, 2);
    put(ip + 12, FAR, 4);
    put(ip + 16, HERE, 4);
    for (int i = 0; i < 20; i += 2)
        sum += (uint32_t)ip[i] << 8 | ip[i + 1];
    put(ip + 10, ~(sum + (sum >> 16)) & 0xffff, 2);
    put(udp, 5000, 2);
    put(udp + 2, port, 2);
    put(udp + 4, 8 + 1, 2);
    udp[8] = byte;
    assert_int_equal(send(far, frame, sizeof frame, 0), sizeof frame);
}

/* Whether a datagram of this byte has come to the far end. */
static bool has_frame(int far, uint8_t byte)
{
    uint8_t frame[256];
    for (ssize_t got; (got = recv(far, frame, sizeof frame, 0)) >= 0;)
        if (got == HEADERS + 1 && frame[14 + 9] == IPPROTO_UDP && frame[HEADERS] == byte)
            return true;
    return false;
}

static void step(struct fl_block *block)
{
    block->release_ns = fl_now_ns() - block->period_ns;
    assert_int_equal(testbed_step(block), FL_OK);
}

/* Steps until the byte has come. */
static void hears(struct fl_block *receive, int far, const char *port, uint8_t byte)
{
    for (int waited = 0; waited < PATIENCE_MS; waited += ROUND_MS) {
        send_frame(far, (uint16_t)atoi(port), byte);
        poll(NULL, 0, ROUND_MS);
        step(receive);
        if (GET(receive, "flag", bool) && GET(receive, "data", uint8_t) == byte)
            return;
    }
    fail_msg("nothing came");
}

static void is_heard(struct fl_block *send, int far, uint8_t byte)
{
    SET(send, "data", uint8_t, byte);
    for (int waited = 0; waited < PATIENCE_MS; waited += ROUND_MS) {
        step(send);
        poll(NULL, 0, ROUND_MS);
        if (has_frame(far, byte))
            return;
    }
    fail_msg("nothing went");
}

static void sends_nothing(struct fl_block *send)
{
    uint32_t sent = GET(send, "sent", uint32_t), failed = GET(send, "failed", uint32_t);
    step(send);
    assert_int_equal(GET(send, "sent", uint32_t), sent);
    assert_int_equal(GET(send, "failed", uint32_t), failed + 1);
}

static void waits_for_its_interface(void **state)
{
    (void)state;
    const char *port = free_port();
    struct fl_block *receive =
        testbed_block("udp-receive", "port", port, "length", "1", "interface", "radio0", "timeout", "60", NULL);
    struct fl_block *send = testbed_block("udp-send", "address", "10.9.0.2", "port", port, "length", "1", "interface",
                                          "radio0", "local_address", "10.9.0.1", NULL);
    receive->service->priority = 2; /* it is in no hurry; in a user namespace this would be refused */
    testbed_begin(receive);
    testbed_begin(send);
    for (uint8_t round = 1; round <= 3; round++) {
        uint32_t sequence = GET(receive, "sequence", uint32_t);
        step(receive);
        assert_int_equal(GET(receive, "sequence", uint32_t), sequence);
        sends_nothing(send);
        int far = plug_in();
        hears(receive, far, port, round);
        is_heard(send, far, round);
        unplug(far);
    }
    assert_int_equal(GET(receive, "refused", uint32_t), 0);
    testbed_end(send);
    testbed_end(receive);
}

/* What comes by another interface is not taken, as before. */
static void keeps_to_its_interface(void **state)
{
    (void)state;
    const char *port = free_port();
    struct fl_block *receive =
        testbed_block("udp-receive", "port", port, "length", "1", "interface", "radio0", "timeout", "60", NULL);
    int far = plug_in(), near = bare("127.0.0.1", 0);
    testbed_begin(receive);
    send_to(near, port, "n", 1);
    hears(receive, far, port, 'f');
    assert_int_equal(GET(receive, "data", uint8_t), 'f');
    unplug(far);
    far = plug_in();
    send_to(near, port, "n", 1);
    hears(receive, far, port, 'g');
    unplug(far);
    close(near);
    testbed_end(receive);
}

/* Another program has the port when the interface comes. */
static void waits_for_its_port(void **state)
{
    (void)state;
    int other = bare("0.0.0.0", 0);
    char port[8];
    snprintf(port, sizeof port, "%u", port_of(other));
    struct fl_block *receive =
        testbed_block("udp-receive", "port", port, "length", "1", "interface", "radio0", "timeout", "60", NULL);
    testbed_begin(receive);
    int far = plug_in();
    step(receive);
    assert_false(GET(receive, "flag", bool));
    close(other);
    hears(receive, far, port, 1);
    unplug(far);
    testbed_end(receive);
}

static void waits_for_its_address(void **state)
{
    (void)state;
    const char *port = free_port();
    int there = bare("127.0.0.1", 0), from = bare("127.0.0.1", 0);
    char far_port[8], byte = 0;
    snprintf(far_port, sizeof far_port, "%u", port_of(there));
    struct fl_block *receive = testbed_block("udp-receive", "port", port, "length", "1", "local_address", "10.9.0.1",
                                             "timeout", "60", "from", "127.0.0.1", NULL);
    struct fl_block *send = testbed_block("udp-send", "address", "127.0.0.1", "port", far_port, "length", "1",
                                          "local_address", "10.9.0.1", NULL);
    testbed_begin(receive);
    testbed_begin(send);
    for (uint32_t round = 1; round <= 3; round++) {
        sends_nothing(send);
        step(receive);
        assert_int_equal(GET(receive, "sequence", uint32_t), round - 1);
        run("ip address add 10.9.0.1/32 dev lo");
        struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons((uint16_t)atoi(port))};
        to.sin_addr.s_addr = htonl(HERE);
        assert_int_equal(sendto(from, "x", 1, 0, (struct sockaddr *)&to, sizeof to), 1);
        settle();
        step(receive);
        assert_int_equal(GET(receive, "sequence", uint32_t), round);
        step(send);
        assert_int_equal(GET(send, "sent", uint32_t), round);
        assert_int_equal(recv(there, &byte, 1, 0), 1);
        run("ip address delete 10.9.0.1/32 dev lo");
    }
    close(from);
    close(there);
    testbed_end(send);
    testbed_end(receive);
}

/* In a namespace when it has an argument. */
int main(int argc, char **argv)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(waits_for_its_interface),
        cmocka_unit_test(keeps_to_its_interface),
        cmocka_unit_test(waits_for_its_port),
        cmocka_unit_test(waits_for_its_address),
    };
    if (argc < 2) {
        execlp("unshare", "unshare", "--map-root-user", "--net", argv[0], "inside", NULL);
        perror("unshare");
        return 1;
    }
    stay_on_one_processor();
    run("ip link set lo up");
    return cmocka_run_group_tests(tests, NULL, NULL);
}
