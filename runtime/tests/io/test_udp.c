#define _GNU_SOURCE
#include "loopback.h"

#include "core/service.h"
#include "core/udp.h"

#include <math.h>
#include <netinet/ip.h>
#include <poll.h>
#include <sys/socket.h>
#include <time.h>

static int stamped; /* a socket that asks for time stamps all the time */

/* When the datagram that waits there arrived, by the kernel. */
static int64_t stamp_ns(int fd)
{
    char byte;
    union {
        struct cmsghdr aligned;
        char bytes[CMSG_SPACE(sizeof(struct timespec))];
    } control;
    struct iovec into = {.iov_base = &byte, .iov_len = 1};
    struct msghdr message = {
        .msg_iov = &into, .msg_iovlen = 1, .msg_control = &control, .msg_controllen = sizeof control};
    struct timespec stamp;
    assert_int_equal(recvmsg(fd, &message, 0), 1);
    assert_non_null(CMSG_FIRSTHDR(&message));
    memcpy(&stamp, CMSG_DATA(CMSG_FIRSTHDR(&message)), sizeof stamp);
    return stamp.tv_sec * INT64_C(1000000000) + stamp.tv_nsec;
}

/* The kernel begins to stamp some time after a first socket asked for it. Until then it gives the time of reading. */
static int await_stamps(void **state)
{
    (void)state;
    enum { ATTEMPTS = 1000, WAIT_NS = 2 * 1000 * 1000 };
    int on = 1;
    stamped = bare("127.0.0.1", 0);
    assert_int_equal(setsockopt(stamped, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on), 0);
    for (int attempt = 0; attempt < ATTEMPTS; attempt++) {
        struct timespec read;
        send_unsettled(stamped, port_of(stamped), "", 1);
        nanosleep(&(struct timespec){.tv_nsec = WAIT_NS}, NULL);
        clock_gettime(CLOCK_REALTIME, &read);
        if (read.tv_sec * INT64_C(1000000000) + read.tv_nsec - stamp_ns(stamped) > WAIT_NS / 2)
            return 0;
    }
    return 1;
}

static int end_stamps(void **state)
{
    (void)state;
    return close(stamped);
}

static void refuses_to_start(struct fl_block *block, const char *reason)
{
    assert_int_equal(block->type->start(block), FL_FAILED);
    if (!strstr(block->service->failure, reason))
        fail_msg("%s", block->service->failure);
    testbed_end(block);
}

static int64_t arrival_ns(struct fl_block *block)
{
    return block->release_ns - llround(GET(block, "age", double) * 1e9);
}

/* The next step is due at `release_ns`. */
static void step_at(struct fl_block *block, int64_t release_ns)
{
    block->release_ns = release_ns - block->period_ns;
    assert_int_equal(testbed_step(block), FL_OK);
}

static void carries(void **state)
{
    (void)state;
    const char *port = free_port();
    struct fl_block *receive = testbed_block("udp-receive", "port", port, "length", "3", "timeout", "60", NULL);
    struct fl_block *send = testbed_block("udp-send", "address", "127.0.0.1", "port", port, "length", "3", NULL);
    testbed_begin(receive);
    testbed_begin(send);
    testbed_step(receive);
    assert_false(GET(receive, "flag", bool));
    assert_int_equal(GET(receive, "sequence", uint32_t), 0);
    for (uint8_t i = 1; i <= 3; i++) {
        memcpy(testbed_input(send, "data"), (uint8_t[]){i, 0xff, 0}, 3);
        testbed_step(send);
        settle();
        step_at(receive, fl_now_ns());
        assert_true(GET(receive, "flag", bool));
        assert_int_equal(GET(receive, "sequence", uint32_t), i);
        assert_memory_equal(testbed_output(receive, "data"), ((uint8_t[]){i, 0xff, 0}), 3);
    }
    assert_int_equal(GET(send, "sent", uint32_t), 3);
    assert_int_equal(GET(send, "failed", uint32_t), 0);
    testbed_end(send);
    testbed_end(receive);
}

static void takes(const char *how, uint8_t first, uint32_t sequence)
{
    const char *port = free_port();
    struct fl_block *receive = testbed_block("udp-receive", "port", port, "length", "1", "take", how, NULL);
    int fd = bare("127.0.0.1", 0);
    testbed_begin(receive);
    for (uint8_t i = 1; i <= 3; i++)
        send_to(fd, port, &i, 1);
    testbed_step(receive);
    assert_int_equal(*(const uint8_t *)testbed_output(receive, "data"), first);
    assert_int_equal(GET(receive, "sequence", uint32_t), sequence);
    testbed_step(receive);
    testbed_step(receive);
    testbed_step(receive);
    assert_int_equal(*(const uint8_t *)testbed_output(receive, "data"), 3);
    assert_int_equal(GET(receive, "sequence", uint32_t), 3);
    close(fd);
    testbed_end(receive);
}

static void takes_newest_or_in_order(void **state)
{
    (void)state;
    takes("newest", 3, 3);
    takes("in-order", 1, 1);
}

/* What comes after the release is for the next step: else it would seem to have come before it was sent. The time of
 * arrival is right but for what two clocks are read apart, which a busy computer makes longer. */
static void a_step_has_what_released_it(void **state)
{
    (void)state;
    enum { APART_NS = 1000 * 1000, LATER_NS = 10 * APART_NS };
    const char *port = free_port();
    struct fl_block *receive = testbed_block("udp-receive", "port", port, "length", "1", NULL);
    int fd = bare("127.0.0.1", 0);
    testbed_begin(receive);
    for (uint8_t i = 1; i <= 2; i++)
        send_to(fd, port, &i, 1);
    int64_t sent_ns = fl_now_ns();
    nanosleep(&(struct timespec){.tv_nsec = LATER_NS}, NULL);
    int64_t released_ns = receive->type->await(receive, INT64_MAX);
    assert_in_range(released_ns, 1, sent_ns + APART_NS);
    send_to(fd, port, "\3", 1);
    step_at(receive, released_ns);
    assert_int_equal(*(const uint8_t *)testbed_output(receive, "data"), 2);
    assert_int_equal(arrival_ns(receive), released_ns);
    assert_true(receive->type->await(receive, 0) > released_ns); /* it is there, however late it is */
    step_at(receive, fl_now_ns());
    assert_int_equal(*(const uint8_t *)testbed_output(receive, "data"), 3);
    assert_int_equal(receive->type->await(receive, 0), 0);
    step_at(receive, fl_now_ns());
    assert_int_equal(GET(receive, "sequence", uint32_t), 3);
    close(fd);
    testbed_end(receive);
}

static void refuses_lengths_and_senders(void **state)
{
    (void)state;
    const char *port = free_port();
    struct fl_block *receive =
        testbed_block("udp-receive", "port", port, "length", "4", "from", "127.0.0.2", "take", "in-order", NULL);
    int right = bare("127.0.0.2", 0), wrong = bare("127.0.0.3", 0);
    testbed_begin(receive);
    send_to(right, port, "abc", 3);
    send_to(right, port, "abcde", 5);
    send_to(right, port, "", 0);
    send_to(wrong, port, "evil", 4);
    testbed_step(receive);
    assert_false(GET(receive, "flag", bool));
    assert_int_equal(GET(receive, "sequence", uint32_t), 0);
    assert_int_equal(GET(receive, "refused", uint32_t), 4);
    send_to(right, port, "good", 4);
    send_to(wrong, port, "evil", 4);
    testbed_step(receive);
    testbed_step(receive);
    assert_true(GET(receive, "flag", bool));
    assert_int_equal(GET(receive, "sequence", uint32_t), 1);
    assert_int_equal(GET(receive, "refused", uint32_t), 5);
    assert_memory_equal(testbed_output(receive, "data"), "good", 4);
    close(right);
    close(wrong);
    testbed_end(receive);
}

/* Two senders that send the same, and the first of them dies and returns. A wide time-out: it is a loaded host's too.
 */
static void listens_to_the_first_that_speaks(void **state)
{
    (void)state;
    const char *port = free_port();
    struct fl_block *receive = testbed_block("udp-receive", "port", port, "length", "1", "from", "127.0.0.2,127.0.0.3",
                                             "failover", "0.5", NULL);
    int first = bare("127.0.0.2", 0), second = bare("127.0.0.3", 0);
    testbed_begin(receive);
    send_to(first, port, "1", 1);
    send_to(second, port, "2", 1);
    testbed_step(receive);
    assert_memory_equal(testbed_output(receive, "data"), "1", 1);
    assert_int_equal(GET(receive, "sender", uint32_t), 0);
    poll(NULL, 0, 600);
    send_to(second, port, "2", 1);
    testbed_step(receive);
    assert_memory_equal(testbed_output(receive, "data"), "2", 1);
    assert_int_equal(GET(receive, "sender", uint32_t), 1);
    send_to(first, port, "1", 1);
    send_to(second, port, "2", 1);
    testbed_step(receive);
    assert_memory_equal(testbed_output(receive, "data"), "1", 1);
    assert_int_equal(GET(receive, "sender", uint32_t), 0);
    assert_int_equal(GET(receive, "sequence", uint32_t), 3);
    assert_int_equal(GET(receive, "refused", uint32_t), 0);
    close(first);
    close(second);
    testbed_end(receive);
}

static void sends_to_several_or_withholds(void **state)
{
    (void)state;
    int first = bare("127.0.0.2", 0), second = bare("127.0.0.3", port_of(first));
    char port[8], byte;
    snprintf(port, sizeof port, "%u", port_of(first));
    struct fl_block *send =
        testbed_block("udp-send", "address", "127.0.0.2,127.0.0.3", "port", port, "length", "1", NULL);
    testbed_begin(send);
    SET(send, "withhold", uint8_t, 1);
    testbed_step(send);
    SET(send, "withhold", uint8_t, 0);
    SET(send, "data", uint8_t, 'x');
    testbed_step(send);
    settle();
    assert_int_equal(GET(send, "sent", uint32_t), 2);
    for (int i = 0; i < 2; i++) {
        int fd = i ? second : first;
        assert_int_equal(recv(fd, &byte, 1, MSG_DONTWAIT), 1);
        assert_int_equal(byte, 'x');
        assert_int_equal(recv(fd, &byte, 1, MSG_DONTWAIT), -1);
        close(fd);
    }
    testbed_end(send);
}

/* Seen to fail without the comparison. */
static void sends_what_is_new_alone(void **state)
{
    (void)state;
    int there = bare("127.0.0.1", 0);
    char port[8];
    snprintf(port, sizeof port, "%u", port_of(there));
    struct fl_block *send = testbed_block("udp-send", "address", "127.0.0.1", "port", port, "length", "1", NULL);
    const struct {
        uint32_t sequence, sent;
    } steps[] = {{0, 1}, {0, 2}, {1, 3}, {1, 3}, {2, 4}, {2, 4}, {9, 5}};
    testbed_begin(send);
    for (size_t i = 0; i < sizeof steps / sizeof steps[0]; i++) {
        SET(send, "sequence", uint32_t, steps[i].sequence);
        testbed_step(send);
        assert_int_equal(GET(send, "sent", uint32_t), steps[i].sent);
    }
    close(there);
    testbed_end(send);
}

static void flags_by_age(void **state)
{
    (void)state;
    const char *port = free_port();
    struct fl_block *receive = testbed_block("udp-receive", "port", port, "length", "1", "timeout", "60", NULL);
    int fd = bare("127.0.0.1", 0);
    testbed_begin(receive);
    send_to(fd, port, "x", 1);
    step_at(receive, fl_now_ns() + 1000000); /* an age above zero, even if stamped when read */
    int64_t arrived = arrival_ns(receive);
    step_at(receive, arrived + 60000000000);
    assert_true(GET(receive, "flag", bool));
    assert_near(GET(receive, "age", double), 60, 1e-9);
    step_at(receive, arrived + 60000000001);
    assert_false(GET(receive, "flag", bool));
    step_at(receive, arrived - 1);
    assert_true(GET(receive, "flag", bool));
    assert_near(GET(receive, "age", double), 0, 0);
    close(fd);
    testbed_end(receive);
}

static void spin(int64_t until_ns)
{
    while (fl_now_ns() < until_ns)
        ;
}

/* Send late after the last step, and step late after that: how much later than sent the datagram is said to have
 * arrived. What is stamped by either step is off by 3 ms. */
static int64_t arrival_after_sending(struct fl_block *receive, int fd, const char *port, int64_t *sending_ns)
{
    spin(fl_now_ns() + 3000000);
    int64_t before = fl_now_ns();
    send_to(fd, port, "x", 1);
    int64_t after = fl_now_ns();
    spin(after + 3000000);
    step_at(receive, fl_now_ns());
    *sending_ns = after - before;
    return arrival_ns(receive) - before;
}

static void ages_from_arrival(void **state)
{
    (void)state;
    const char *port = free_port();
    struct fl_block *receive = testbed_block("udp-receive", "port", port, "length", "1", NULL);
    int fd = bare("127.0.0.1", 0);
    int64_t sending, latest = INT64_MIN;
    testbed_begin(receive);
    /* The kernel begins to stamp some time after it was first asked to; until then it stamps when read. */
    for (int round = 0; arrival_after_sending(receive, fd, port, &sending) > sending + 1000000; round++)
        assert_true(round < 1000);
    for (int i = 0; i < 20; i++) {
        int64_t arrival = arrival_after_sending(receive, fd, port, &sending);
        assert_true(arrival <= sending + 1000000);
        if (arrival > latest)
            latest = arrival;
    }
    /* A step that is interrupted between reading two clocks takes a datagram for older than it is, but not every one.
     */
    assert_true(latest > -1000000);
    close(fd);
    testbed_end(receive);
}

static void stamps_survive_a_set_clock(void **state)
{
    (void)state;
    /* stamp, wall clock now, monotonic now, monotonic when last empty */
    assert_int_equal(udp_arrival_ns(900, 1000, 50500, 50000), 50400);
    assert_int_equal(udp_arrival_ns(900, 1000000000, 50500, 50000), 50000); /* set forward since */
    assert_int_equal(udp_arrival_ns(900, 100, 50500, 50000), 50500);        /* set back since */
    assert_int_equal(udp_arrival_ns(INT64_MAX, INT64_C(1800000000000000000), 50500, 50000), 50500); /* no stamp */
}

/* A sender of 1 kHz, and steps of 100 ms. Seen to fail: the first step gave datagram 64 of 100. */
static void gives_the_newest_of_many(void **state)
{
    (void)state;
    enum { STEPS = 10, MANY = 100 };
    const char *port = free_port();
    struct fl_block *receive = testbed_block("udp-receive", "port", port, "length", "4", NULL);
    int fd = bare("127.0.0.1", 0);
    uint32_t sent = 0, received;
    testbed_begin(receive);
    for (int step = 0; step < STEPS; step++) {
        for (int i = 0; i < MANY; i++) {
            sent++;
            send_to(fd, port, &sent, sizeof sent);
        }
        testbed_step(receive);
        memcpy(&received, testbed_output(receive, "data"), sizeof received);
        assert_int_equal(received, sent);
        assert_int_equal(GET(receive, "sequence", uint32_t), sent);
    }
    close(fd);
    testbed_end(receive);
}

/* More than the queue holds: the step ends, and what comes after it is the newest in the next one. */
static void bounds_a_burst(void **state)
{
    (void)state;
    const char *port = free_port();
    struct fl_block *receive = testbed_block("udp-receive", "port", port, "length", "1", NULL);
    int fd = bare("127.0.0.1", 0);
    testbed_begin(receive);
    for (int i = 0; i < 5 * SOCKET_BURST; i++)
        send_to(fd, port, "x", 1);
    testbed_step(receive);
    uint32_t taken = GET(receive, "sequence", uint32_t);
    assert_in_range(taken, 1, SOCKET_BURST - 1); /* all that waited */
    send_to(fd, port, "y", 1);
    testbed_step(receive);
    assert_int_equal(GET(receive, "sequence", uint32_t), taken + 1);
    assert_int_equal(GET(receive, "data", uint8_t), 'y');
    close(fd);
    testbed_end(receive);
}

static void counts_drops(void **state)
{
    (void)state;
    enum { FLOOD = 20000 };
    const char *port = free_port();
    struct fl_block *receive = testbed_block("udp-receive", "port", port, "length", "1", NULL);
    int fd = bare("127.0.0.1", 0);
    testbed_begin(receive);
    for (int i = 0; i < FLOOD; i++) {
        send_unsettled(fd, (uint16_t)atoi(port), "x", 1);
        if (i % 100 == 99)
            settle(); /* drops shall be the socket's, not those of a queue before it */
    }
    uint32_t before;
    do {
        before = GET(receive, "sequence", uint32_t);
        testbed_step(receive);
    } while (GET(receive, "sequence", uint32_t) != before);
    send_to(fd, port, "x", 1);
    testbed_step(receive);
    assert_in_range(GET(receive, "dropped", uint32_t), 1, FLOOD);
    assert_int_equal(GET(receive, "dropped", uint32_t) + GET(receive, "sequence", uint32_t), FLOOD + 1);
    close(fd);
    testbed_end(receive);
}

/* Strangers, and wrong lengths, before, between and after: more than a step takes, and more than the queue holds. The
 * true datagrams are taken in the next step, none of them is lost, and what is refused is counted apart from what is
 * lost. */
static void strangers_take_no_room(void **state)
{
    (void)state;
    enum { FLOOD = 2000, LONG = 1000 };
    static const char datagram[LONG + 1];
    const char *port = free_port();
    struct fl_block *receive =
        testbed_block("udp-receive", "port", port, "length", "1000", "from", "127.0.0.1,127.0.0.4", NULL);
    int first = bare("127.0.0.1", 0), last = bare("127.0.0.4", 0), other = bare("127.0.0.2", 0);
    testbed_begin(receive);
    for (uint32_t round = 1; round <= 2; round++) {
        for (int i = 0; i < FLOOD; i++) {
            send_unsettled(other, (uint16_t)atoi(port), datagram, LONG);
            send_unsettled(i & 1 ? first : last, (uint16_t)atoi(port), datagram, i % 3 ? LONG - 1 : LONG + 1);
            if (i % 50 == 49)
                settle();
            if (i == FLOOD / 2)
                send_to(first, port, datagram, LONG);
        }
        settle();
        testbed_step(receive);
        assert_int_equal(GET(receive, "sequence", uint32_t), round);
        assert_int_equal(GET(receive, "refused", uint32_t), 2 * FLOOD * round);
        assert_int_equal(GET(receive, "dropped", uint32_t), 0);
    }
    close(first);
    close(last);
    close(other);
    testbed_end(receive);
}

static void broadcasts_where_allowed(void **state)
{
    (void)state;
    const char *port = free_port();
    struct fl_block *receive = testbed_block("udp-receive", "port", port, "length", "1", NULL);
    struct fl_block *send = testbed_block("udp-send", "address", "127.255.255.255", "port", port, "length", "1",
                                          "broadcast", "true", "interface", "lo", NULL);
    testbed_begin(receive);
    testbed_begin(send);
    SET(send, "data", uint8_t, 7);
    testbed_step(send);
    settle();
    testbed_step(receive);
    assert_int_equal(GET(receive, "sequence", uint32_t), 1);
    testbed_end(send);
    testbed_end(receive);
    send = testbed_block("udp-send", "address", "127.255.255.255", "port", port, "length", "1", NULL);
    refuses_to_start(send, "127.255.255.255 is the broadcast address of a network; allow it by broadcast: true");
    assert_non_null(strstr(testbed_refusal("udp-send", "address", "255.255.255.255", "port", port, "length", "1", NULL),
                           "255.255.255.255 is a broadcast address; allow it by broadcast: true"));
}

static void marks_service(void **state)
{
    (void)state;
    int fd = bare("127.0.0.1", 0), on = 1;
    char port[8], control[64], byte;
    struct iovec part = {&byte, 1};
    struct msghdr message = {
        .msg_iov = &part, .msg_iovlen = 1, .msg_control = control, .msg_controllen = sizeof control};
    assert_int_equal(setsockopt(fd, IPPROTO_IP, IP_RECVTOS, &on, sizeof on), 0);
    snprintf(port, sizeof port, "%u", port_of(fd));
    struct fl_block *send = testbed_block("udp-send", "address", "127.0.0.1", "local_address", "127.0.0.9", "port",
                                          port, "length", "1", "dscp", "46", NULL);
    struct sockaddr_in sender;
    message.msg_name = &sender;
    message.msg_namelen = sizeof sender;
    testbed_begin(send);
    testbed_step(send);
    settle();
    assert_int_equal(recvmsg(fd, &message, MSG_DONTWAIT), 1);
    struct cmsghdr *service = CMSG_FIRSTHDR(&message);
    assert_non_null(service);
    assert_int_equal(service->cmsg_type, IP_TOS);
    assert_int_equal(*CMSG_DATA(service), 0xb8); /* RFC 3246: expedited forwarding */
    assert_int_equal(ntohl(sender.sin_addr.s_addr), 0x7f000009);
    close(fd);
    testbed_end(send);
}

static void counts_what_no_network_takes(void **state)
{
    (void)state;
    /* Whatever networks there are, none takes what comes from the loopback and is for elsewhere. */
    struct fl_block *send = testbed_block("udp-send", "address", "192.0.2.1", "port", "5000", "length", "1",
                                          "local_address", "127.0.0.1", NULL);
    testbed_begin(send);
    assert_int_equal(testbed_step(send), FL_OK);
    assert_int_equal(testbed_step(send), FL_OK);
    assert_int_equal(GET(send, "failed", uint32_t), 2);
    assert_int_equal(GET(send, "sent", uint32_t), 0);
    testbed_end(send);
}

static const char *said_of_send(const char *address, const char *local_address)
{
    return testbed_refusal("udp-send", "port", "5000", "length", "1", "address", address, "local_address",
                           local_address, NULL);
}

static const char *said_of_receive(const char *local_address, const char *from)
{
    return testbed_refusal("udp-receive", "port", "5000", "length", "1", "local_address", local_address, "from", from,
                           NULL);
}

static void refuses(void **state)
{
    (void)state;
    static const struct {
        const char *type, *name, *value, *reason;
    } bad[] = {
        {"udp-send", "dscp", "64", "parameter dscp: 64 is outside 0 to 63"},
        {"udp-send", "port", "0", "parameter port: 0 is outside 1 to 65535"},
        {"udp-send", "length", "1473", "parameter length: 1473 is outside 1 to 1472 B"},
        {"udp-receive", "port", "65536", "parameter port: 65536 is outside 1 to 65535"},
        {"udp-receive", "length", "0", "parameter length: 0 is outside 1 to 1472 B"},
        {"udp-receive", "take", "oldest", "oldest is not one of newest|in-order"},
        {"udp-receive", "timeout", "-1", "parameter timeout: -1 is outside 0.001 to 3600 s"},
    };
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
        const char *said = testbed_refusal(bad[i].type, bad[i].name, bad[i].value, NULL);
        if (!strstr(said, bad[i].reason))
            fail_msg("%s: %s", bad[i].reason, said);
    }
    assert_non_null(strstr(said_of_send("224.0.0.1", "0.0.0.0"), "224.0.0.1 is a multicast group"));
    assert_non_null(strstr(said_of_send("robot3", "0.0.0.0"), "address: robot3 is not an IPv4 address such as"));
    assert_non_null(strstr(said_of_send("0.0.0.0", "0.0.0.0"), "0.0.0.0 is not an address to send to"));
    assert_non_null(strstr(said_of_send("127.0.0.1", "::1"), "local_address: ::1 is not an IPv4 address"));
    assert_non_null(strstr(said_of_receive("0.0.0.0", "10.0.0"), "from: 10.0.0 is not an IPv4 address"));
    assert_non_null(strstr(said_of_receive("239.1.2.3", "0.0.0.0"), "239.1.2.3 is a multicast group"));
    assert_non_null(strstr(said_of_receive("0.0.0.0", "10.0.0.1,0.0.0.0"), "from: 0.0.0.0 is anybody"));
    assert_non_null(strstr(said_of_receive("0.0.0.0", "10.0.0.1,10.0.0.2,10.0.0.3,10.0.0.4,10.0.0.5"),
                           "from: give 1 to 4 addresses"));
}

static void refuses_to_start_without(void **state)
{
    (void)state;
    const char *port = free_port();
    refuses_to_start(
        testbed_block("udp-receive", "port", port, "length", "1", "interface", "a-name-that-is-too-long", NULL),
        "interface: a-name-that-is-too-long is longer than the 15 characters of a name");
    struct fl_block *first = testbed_block("udp-receive", "port", port, "length", "1", NULL);
    testbed_begin(first);
    refuses_to_start(testbed_block("udp-receive", "port", port, "length", "1", NULL), "another block or program");
    testbed_end(first);
    first = testbed_block("udp-receive", "port", port, "length", "1", NULL); /* the port is free again */
    testbed_begin(first);
    testbed_end(first);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(carries),
        cmocka_unit_test(takes_newest_or_in_order),
        cmocka_unit_test(a_step_has_what_released_it),
        cmocka_unit_test(refuses_lengths_and_senders),
        cmocka_unit_test(listens_to_the_first_that_speaks),
        cmocka_unit_test(sends_to_several_or_withholds),
        cmocka_unit_test(sends_what_is_new_alone),
        cmocka_unit_test(flags_by_age),
        cmocka_unit_test(ages_from_arrival),
        cmocka_unit_test(stamps_survive_a_set_clock),
        cmocka_unit_test(gives_the_newest_of_many),
        cmocka_unit_test(bounds_a_burst),
        cmocka_unit_test(counts_drops),
        cmocka_unit_test(strangers_take_no_room),
        cmocka_unit_test(broadcasts_where_allowed),
        cmocka_unit_test(marks_service),
        cmocka_unit_test(counts_what_no_network_takes),
        cmocka_unit_test(refuses),
        cmocka_unit_test(refuses_to_start_without),
    };
    stay_on_one_processor();
    return cmocka_run_group_tests(tests, await_stamps, end_stamps);
}
