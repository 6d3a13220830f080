/* udp-send and udp-receive with keys, and who has none between them. Robots are addresses of loopback. */
#define _GNU_SOURCE
#include "loopback.h"

#include "core/authentication.h"
#include "core/service.h"
#include "seccomp.h"

#include <sys/stat.h>

#define ROBOT "127.0.0.2"

static char directory[] = "/tmp/flotilla-keys-XXXXXX";
static char file[64];

#define A_KEY  "000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f"
#define NO_KEY "ff0102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f"

static void write_keys(const char *text)
{
    FILE *stream = fopen(file, "we");
    assert_non_null(stream);
    assert_true(fputs(text, stream) >= 0);
    assert_int_equal(fclose(stream), 0);
}

static int begin(void **state)
{
    (void)state;
    assert_non_null(mkdtemp(directory));
    snprintf(file, sizeof file, "%s/message-keys", directory);
    /* Both computers have one file here: what goes to 127.0.0.1 comes from ROBOT. */
    write_keys("127.0.0.1 " A_KEY " " NO_KEY "\n" ROBOT " " NO_KEY " " A_KEY "\n");
    return 0;
}

static int end(void **state)
{
    (void)state;
    unlink(file);
    return rmdir(directory);
}

/* Its period is long: to look at what is refused has all the time that a busy computer takes. */
static struct fl_block *receiver(const char *port, const char *take)
{
    struct fl_block *receive =
        testbed_block("udp-receive", "port", port, "length", "4", "from", ROBOT, "take", take, "keys", file, NULL);
    testbed_begin(receive);
    receive->period_ns = INT64_C(3600000000000);
    return receive;
}

static struct fl_block *sender(const char *port)
{
    struct fl_block *send = testbed_block("udp-send", "address", "127.0.0.1", "local_address", ROBOT, "port", port,
                                          "length", "4", "keys", file, NULL);
    testbed_begin(send);
    return send;
}

static void exchange(struct fl_block *send, struct fl_block *receive)
{
    testbed_step(send);
    settle();
    testbed_step(receive);
    settle();
}

static void carries_from_the_second_message_on(void **state)
{
    (void)state;
    const char *port = free_port();
    struct fl_block *receive = receiver(port, "newest"), *send = sender(port);
    for (uint8_t i = 0; i < 5; i++) {
        memcpy(testbed_input(send, "data"), (uint8_t[]){i, 2, 3, 4}, 4);
        exchange(send, receive);
        assert_int_equal(GET(receive, "sequence", uint32_t), i);
        if (i)
            assert_memory_equal(testbed_output(receive, "data"), ((uint8_t[]){i, 2, 3, 4}), 4);
    }
    assert_int_equal(GET(receive, "replayed", uint32_t), 1);
    assert_int_equal(GET(receive, "forged", uint32_t), 0);
    assert_int_equal(GET(send, "sent", uint32_t), 5);
    assert_int_equal(GET(send, "forged", uint32_t), 0);

    testbed_end(receive); /* it restarts, */
    receive = receiver(port, "newest");
    for (uint8_t i = 0; i < 3; i++)
        exchange(send, receive);
    assert_int_equal(GET(receive, "sequence", uint32_t), 2);

    testbed_end(send); /* and so does the sender */
    send = sender(port);
    for (uint8_t i = 0; i < 3; i++)
        exchange(send, receive);
    assert_int_equal(GET(receive, "sequence", uint32_t), 4);
    assert_int_equal(GET(send, "forged", uint32_t), 0);
    testbed_end(send);
    testbed_end(receive);
}

/* A bare socket with the robot's own address: it forges all that a firewall can see. */
static void refuses_what_is_forged_or_replayed(void **state)
{
    (void)state;
    uint8_t recorded[4 + AUTHENTICATION_TRAILER + 1];
    char copy[8];
    int listener = bare("127.0.0.1", 0);
    snprintf(copy, sizeof copy, "%u", port_of(listener));
    struct fl_block *send = sender(copy); /* recorded on its way */
    testbed_step(send);
    settle();
    assert_int_equal(recv(listener, recorded, sizeof recorded, MSG_DONTWAIT), 4 + AUTHENTICATION_TRAILER);
    close(listener);

    struct fl_block *receive = receiver(copy, "in-order");
    int attacker = bare(ROBOT, 0);
    for (int i = 0; i < 3; i++)
        exchange(send, receive);
    uint32_t sequence = GET(receive, "sequence", uint32_t), replayed = GET(receive, "replayed", uint32_t);
    send_to(attacker, copy, recorded, 4 + AUTHENTICATION_TRAILER);
    testbed_step(receive);
    assert_int_equal(GET(receive, "replayed", uint32_t), replayed + 1);
    recorded[0] ^= 1;
    send_to(attacker, copy, recorded, 4 + AUTHENTICATION_TRAILER);
    testbed_step(receive);
    assert_int_equal(GET(receive, "forged", uint32_t), 1);
    send_to(attacker, copy, "open", 4); /* as without keys */
    testbed_step(receive);
    assert_int_equal(GET(receive, "refused", uint32_t), 1);
    assert_int_equal(GET(receive, "sequence", uint32_t), sequence);
    exchange(send, receive);
    assert_int_equal(GET(receive, "sequence", uint32_t), sequence + 1);
    close(attacker);
    testbed_end(send);
    testbed_end(receive);
}

static void send_back(int fd, const struct sockaddr_in *to, const void *bytes, size_t count)
{
    assert_int_equal(sendto(fd, bytes, count, 0, (const struct sockaddr *)to, sizeof *to), count);
    settle();
}

/* What comes back to the sender: the receiver's challenge, and what anybody makes up. Seen to fail with the length not
 * counted, with the tag looked at after the session only, and where each answer that changes nothing is forged. */
static void refuses_what_is_no_challenge_of_the_receiver(void **state)
{
    (void)state;
    uint8_t message[4 + AUTHENTICATION_TRAILER], key[AUTHENTICATION_KEY];
    uint8_t challenge[AUTHENTICATION_CHALLENGE], made_up[AUTHENTICATION_CHALLENGE + 1] = {0};
    char port[8];
    struct sockaddr_in from;
    socklen_t size = sizeof from;
    struct authentication_receiver receive;
    int listener = bare("127.0.0.1", 0), attacker = bare("127.0.0.1", 0);
    for (size_t i = 0; i < sizeof key; i++)
        key[i] = (uint8_t)i; /* A_KEY */
    authentication_receiver_begin(&receive, key, port_of(listener));
    snprintf(port, sizeof port, "%u", port_of(listener));
    struct fl_block *send = sender(port);
    testbed_step(send);
    settle();
    assert_int_equal(recvfrom(listener, message, sizeof message, MSG_DONTWAIT, (struct sockaddr *)&from, &size),
                     sizeof message);
    assert_int_equal(authentication_judge(&receive, message, 4, message + 4, challenge), AUTHENTICATION_UNANSWERED);

    const size_t lengths[] = {0, 1, AUTHENTICATION_CHALLENGE - 1, AUTHENTICATION_CHALLENGE, sizeof made_up};
    for (size_t i = 0; i < sizeof lengths / sizeof lengths[0]; i++) {
        send_back(attacker, &from, made_up, lengths[i]);
        testbed_step(send);
        assert_int_equal(GET(send, "forged", uint32_t), i + 1);
    }
    memcpy(made_up, challenge, sizeof challenge);
    made_up[0] ^= 1; /* as of another session */
    send_back(attacker, &from, made_up, sizeof challenge);
    testbed_step(send);
    assert_int_equal(GET(send, "forged", uint32_t), 6);

    for (int again = 0; again < 3; again++) {
        send_back(attacker, &from, challenge, sizeof challenge); /* whoever repeats it */
        testbed_step(send);
    }
    assert_int_equal(GET(send, "forged", uint32_t), 6);
    settle();
    enum authentication_verdict verdict = AUTHENTICATION_FORGED;
    while (recv(listener, message, sizeof message, MSG_DONTWAIT) > 0)
        verdict = authentication_judge(&receive, message, 4, message + 4, challenge);
    assert_int_equal(verdict, AUTHENTICATION_GOOD); /* the sender answers */
    close(attacker);
    close(listener);
    testbed_end(send);
}

static void flood(int attacker, const char *port)
{
    static const uint8_t nonsense[4 + AUTHENTICATION_TRAILER] = "open";
    for (int i = 0; i < 40; i++)
        send_to(attacker, port, nonsense, sizeof nonsense);
}

/* Without a time for that, one is looked at, so that a flood ends at all; with a long one, all. */
static void refuses_for_a_share_of_the_period(void **state)
{
    (void)state;
    const char *port = free_port();
    struct fl_block *receive = receiver(port, "newest");
    int attacker = bare(ROBOT, 0);
    flood(attacker, port);
    const int64_t period_ns = receive->period_ns;
    receive->period_ns = 0;
    testbed_step(receive);
    assert_int_equal(GET(receive, "forged", uint32_t), 1);
    testbed_step(receive);
    assert_int_equal(GET(receive, "forged", uint32_t), 2);
    receive->period_ns = period_ns;
    testbed_step(receive);
    assert_int_equal(GET(receive, "forged", uint32_t), 40);
    close(attacker);
    testbed_end(receive);
}

/* Sending, asking, answering and refusing are for the step: none of it may block. Seen to fail with recv() that waits.
 */
static void steps_do_not_block(void **state)
{
    (void)state;
    const char *port = free_port();
    struct fl_block *receive = receiver(port, "newest"), *send = sender(port);
    int attacker = bare(ROBOT, 0);
    testbed_step(send);
    flood(attacker, port);
    steps_under_seccomp(receive, 2); /* refuses, and asks */
    steps_under_seccomp(send, 2);    /* answers; what they change is lost, but not what the network has */
    steps_under_seccomp(receive, 2);
    close(attacker);
    testbed_end(send);
    testbed_end(receive);
}

/* They share its step's budget of 64 datagrams. */
static void a_flood_does_not_hide_the_sender(void **state)
{
    (void)state;
    const char *port = free_port();
    struct fl_block *receive = receiver(port, "in-order"), *send = sender(port);
    int attacker = bare(ROBOT, 0);
    for (int i = 0; i < 2; i++)
        exchange(send, receive);
    for (uint32_t i = 1; i <= 10; i++) {
        flood(attacker, port);
        exchange(send, receive);
        assert_int_equal(GET(receive, "sequence", uint32_t), 1 + i);
        assert_int_equal(GET(receive, "forged", uint32_t), 40 * i);
    }
    close(attacker);
    testbed_end(send);
    testbed_end(receive);
}

static void refused(const char *type, const char *addresses, const char *reason)
{
    bool sends = !strcmp(type, "udp-send");
    const char *said =
        testbed_refusal(type, "port", "5000", "length", "1", "keys", file, sends ? "address" : "from", addresses, NULL);
    if (!strstr(said, reason))
        fail_msg("%s", said);
}

static void refuses_who_can_have_no_key(void **state)
{
    (void)state;
    refused("udp-receive", "0.0.0.0", "0.0.0.0 is many computers, and each has a key of its own; name them by from");
    refused("udp-send", "255.255.255.255", "255.255.255.255 is a broadcast address");
    assert_non_null(strstr(testbed_refusal("udp-send", "address", "127.0.0.1", "port", "5000", "length", "1", "keys",
                                           file, "broadcast", "true", NULL),
                           "each has a key of its own"));
    assert_non_null(strstr(
        testbed_refusal("udp-send", "address", "127.0.0.1", "port", "5000", "length", "1433", "keys", file, NULL),
        "with keys a payload has at most 1432 bytes"));
}

static void refuses_to_start(const char *keys, const char *reason)
{
    struct fl_block *receive =
        testbed_block("udp-receive", "port", free_port(), "length", "4", "from", ROBOT, "keys", keys, NULL);
    assert_int_equal(receive->type->start(receive), FL_FAILED);
    if (!strstr(receive->service->failure, reason))
        fail_msg("%s", receive->service->failure);
    testbed_end(receive);
}

static void refuses_to_start_without_a_key(void **state)
{
    (void)state;
    refuses_to_start("/nowhere/keys", "parameter keys: /nowhere/keys: No such file or directory");
    setenv("CREDENTIALS_DIRECTORY", "/nowhere", 1);
    refuses_to_start("keys", "parameter keys: /nowhere/keys: No such file or directory");
    unsetenv("CREDENTIALS_DIRECTORY");
    refuses_to_start("no-keys", "parameter keys: /etc/flotilla/no-keys: No such file or directory");
    const char *none[] = {
        "",
        "127.0.0.1 " A_KEY " " A_KEY "\n",
        ROBOT " " A_KEY "\n",
        ROBOT " " A_KEY " short\n",
        ROBOT " " A_KEY " zz0102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f\n",
    };
    for (size_t i = 0; i < sizeof none / sizeof none[0]; i++) {
        write_keys(none[i]);
        refuses_to_start(file, "has no key for " ROBOT);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(carries_from_the_second_message_on),
        cmocka_unit_test(refuses_what_is_forged_or_replayed),
        cmocka_unit_test(refuses_what_is_no_challenge_of_the_receiver),
        cmocka_unit_test(a_flood_does_not_hide_the_sender),
        cmocka_unit_test(steps_do_not_block),
        cmocka_unit_test(refuses_for_a_share_of_the_period),
        cmocka_unit_test(refuses_who_can_have_no_key),
        cmocka_unit_test(refuses_to_start_without_a_key),
    };
    stay_on_one_processor();
    return cmocka_run_group_tests(tests, begin, end);
}
