#include "testbed.h"

#include "core/authentication.h"

enum { LENGTH = 5, PORT = 5012, MESSAGE = LENGTH + AUTHENTICATION_TRAILER };

static const uint8_t key[AUTHENTICATION_KEY] = {1, 2, 3}, other_key[AUTHENTICATION_KEY] = {1, 2, 4};

/* A message on its way, which may be recorded. */
struct message {
    uint8_t bytes[MESSAGE];
};

static struct authentication_sender sender;
static struct authentication_receiver receiver;
static uint8_t challenge[AUTHENTICATION_CHALLENGE];

static struct message next(void)
{
    struct message message = {"hello"};
    authentication_sign(&sender, message.bytes, LENGTH);
    return message;
}

static enum authentication_verdict judge(struct message message)
{
    return authentication_judge(&receiver, message.bytes, LENGTH, message.bytes + LENGTH, challenge);
}

static enum authentication_verdict answer(void)
{
    return authentication_challenged(&sender, challenge, sizeof challenge);
}

static int begin(void **state)
{
    (void)state;
    authentication_sender_begin(&sender, key, PORT);
    authentication_receiver_begin(&receiver, key, PORT);
    return 0;
}

/* Both know each other. */
static int meet(void **state)
{
    begin(state);
    assert_int_equal(judge(next()), AUTHENTICATION_UNANSWERED);
    assert_int_equal(answer(), AUTHENTICATION_GOOD);
    assert_int_equal(judge(next()), AUTHENTICATION_GOOD);
    return 0;
}

static void takes_what_answers(void **state)
{
    (void)state;
    assert_int_equal(judge(next()), AUTHENTICATION_UNANSWERED);
    struct message unanswered = next();
    assert_int_equal(answer(), AUTHENTICATION_GOOD);
    assert_int_equal(answer(), AUTHENTICATION_REPLAYED); /* once */
    for (int i = 0; i < 100; i++)
        assert_int_equal(judge(next()), AUTHENTICATION_GOOD);
    assert_int_equal(judge(unanswered), AUTHENTICATION_REPLAYED);
}

/* Seen to fail with `<` for `<=` in the comparison of counters. */
static void takes_each_once_and_in_order(void **state)
{
    (void)state;
    struct message first = next(), second = next(), third = next();
    assert_int_equal(judge(first), AUTHENTICATION_GOOD);
    assert_int_equal(judge(first), AUTHENTICATION_REPLAYED);
    assert_int_equal(judge(third), AUTHENTICATION_GOOD);
    assert_int_equal(judge(second), AUTHENTICATION_REPLAYED);
    assert_int_equal(judge(third), AUTHENTICATION_REPLAYED);
    assert_int_equal(judge(next()), AUTHENTICATION_GOOD);
}

/* Each of all bits: payload, numbers, tag. */
static void refuses_each_flipped_bit(void **state)
{
    (void)state;
    struct message good = next();
    for (size_t bit = 0; bit < 8 * sizeof good.bytes; bit++) {
        struct message flipped = good;
        flipped.bytes[bit / 8] ^= (uint8_t)(1U << bit % 8);
        if (judge(flipped) != AUTHENTICATION_FORGED)
            fail_msg("bit %zu", bit);
    }
    assert_int_equal(judge(good), AUTHENTICATION_GOOD);
}

static void refuses_other_keys_and_ports(void **state)
{
    authentication_receiver_begin(&receiver, other_key, PORT);
    assert_int_equal(judge(next()), AUTHENTICATION_FORGED);
    authentication_receiver_begin(&receiver, key, PORT + 1);
    assert_int_equal(judge(next()), AUTHENTICATION_FORGED);
    begin(state);
    assert_int_equal(judge(next()), AUTHENTICATION_UNANSWERED);
}

static void begin_another_session(void)
{
    authentication_sender_begin(&sender, key, PORT);
    assert_int_equal(judge(next()), AUTHENTICATION_UNANSWERED);
    assert_int_equal(answer(), AUTHENTICATION_GOOD);
    assert_int_equal(judge(next()), AUTHENTICATION_GOOD);
}

/* Messages that answer the right challenge, recorded and kept back until the next session has begun. Seen to fail with
 * `taken = 1` for `taken++`. */
static void refuses_an_earlier_session(void **state)
{
    (void)state;
    for (int session = 0; session < 3; session++) {
        struct message recorded[3] = {next(), next(), next()};
        assert_int_equal(judge(recorded[0]), AUTHENTICATION_GOOD);
        begin_another_session();
        for (int i = 0; i < 3; i++) {
            assert_int_equal(judge(recorded[i]), AUTHENTICATION_UNANSWERED);
            assert_int_equal(answer(), AUTHENTICATION_REPLAYED); /* it is not of this session */
            assert_int_equal(judge(next()), AUTHENTICATION_GOOD);
        }
    }
}

static void refuses_what_an_earlier_receiver_took(void **state)
{
    (void)state;
    struct message recorded = next();
    assert_int_equal(judge(recorded), AUTHENTICATION_GOOD);
    authentication_receiver_begin(&receiver, key, PORT);
    assert_int_equal(judge(recorded), AUTHENTICATION_UNANSWERED);
    struct message lost = next();
    assert_int_equal(judge(lost), AUTHENTICATION_UNANSWERED);
    assert_int_equal(answer(), AUTHENTICATION_GOOD);
    assert_int_equal(judge(recorded), AUTHENTICATION_UNANSWERED);
    assert_int_equal(judge(next()), AUTHENTICATION_GOOD);
    assert_int_equal(judge(recorded), AUTHENTICATION_REPLAYED);
}

/* Who records challenges cannot make the sender give old answers. Seen to fail without the comparison of counters. */
static void an_old_challenge_changes_nothing(void **state)
{
    (void)state;
    authentication_receiver_begin(&receiver, key, PORT);
    assert_int_equal(judge(next()), AUTHENTICATION_UNANSWERED);
    uint8_t recorded[AUTHENTICATION_CHALLENGE];
    memcpy(recorded, challenge, sizeof recorded);
    assert_int_equal(answer(), AUTHENTICATION_GOOD);
    authentication_receiver_begin(&receiver, key, PORT);
    assert_int_equal(judge(next()), AUTHENTICATION_UNANSWERED);
    assert_int_equal(answer(), AUTHENTICATION_GOOD);
    assert_int_equal(authentication_challenged(&sender, recorded, sizeof recorded), AUTHENTICATION_REPLAYED);
    assert_int_equal(judge(next()), AUTHENTICATION_GOOD);
}

static void refuses_each_flipped_bit_of_a_challenge(void **state)
{
    (void)state;
    assert_int_equal(judge(next()), AUTHENTICATION_UNANSWERED);
    for (size_t bit = 0; bit < 8 * sizeof challenge; bit++) {
        challenge[bit / 8] ^= (uint8_t)(1U << bit % 8);
        if (answer() != AUTHENTICATION_FORGED)
            fail_msg("bit %zu", bit);
        challenge[bit / 8] ^= (uint8_t)(1U << bit % 8);
    }
    for (size_t length = 0; length <= sizeof challenge + 1; length += length == sizeof challenge - 1 ? 2 : 1)
        assert_int_equal(authentication_challenged(&sender, challenge, length), AUTHENTICATION_FORGED);
    assert_int_equal(answer(), AUTHENTICATION_GOOD);
}

/* A message reflected to its sender is none to it, even where both directions had one key. */
static void a_message_is_no_challenge(void **state)
{
    (void)state;
    struct message message = next();
    assert_int_equal(authentication_challenged(&sender, message.bytes + LENGTH, AUTHENTICATION_TRAILER),
                     AUTHENTICATION_FORGED);
}

/* Counters of one session would repeat its nonces. */
static void a_session_ends(void **state)
{
    (void)state;
    uint64_t before = sender.session;
    sender.counter = UINT32_MAX - 1;
    assert_int_equal(judge(next()), AUTHENTICATION_GOOD);
    assert_int_equal(judge(next()), AUTHENTICATION_UNANSWERED);
    assert_true(sender.session != before);
    assert_int_equal(answer(), AUTHENTICATION_GOOD);
    assert_int_equal(judge(next()), AUTHENTICATION_GOOD);
}

static void sessions_differ(void **state)
{
    (void)state;
    for (int i = 0; i < 100; i++) {
        uint64_t before = sender.session;
        authentication_sender_begin(&sender, key, PORT);
        assert_true(sender.session != before);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup(takes_what_answers, begin),
        cmocka_unit_test_setup(takes_each_once_and_in_order, meet),
        cmocka_unit_test_setup(refuses_each_flipped_bit, meet),
        cmocka_unit_test_setup(refuses_other_keys_and_ports, begin),
        cmocka_unit_test_setup(refuses_an_earlier_session, meet),
        cmocka_unit_test_setup(refuses_what_an_earlier_receiver_took, meet),
        cmocka_unit_test_setup(an_old_challenge_changes_nothing, meet),
        cmocka_unit_test_setup(refuses_each_flipped_bit_of_a_challenge, begin),
        cmocka_unit_test_setup(a_message_is_no_challenge, meet),
        cmocka_unit_test_setup(a_session_ends, meet),
        cmocka_unit_test_setup(sessions_differ, begin),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
