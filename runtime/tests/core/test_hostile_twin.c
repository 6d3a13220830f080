/* Hot standby with a hostile twin, by a clock that counts: two controllers and who poses as both, 1,000 runs.
 *
 * Receiver and senders are the runtime's; time, network and powers are not. In each run the controllers lose power and
 * return at random instants, the receiver restarts, messages get lost, and the twin, who hears all but has no key,
 * repeats, delays, alters and makes up messages under the address of either. */
#include "testbed.h"

#include "core/authentication.h"

#include <flotilla/failover.h>

enum {
    RUNS = 1000,
    STEPS = 2000, /* of 10 ms */
    CONTROLLERS = 2,
    PAYLOAD = 5, /* who, and a number of the message */
    MESSAGE = PAYLOAD + AUTHENTICATION_TRAILER,
    RECORDED = 64,
    PORT = 5013,
};

static const int64_t STEP_NS = 10000000;
static const double TIMEOUT_S = 0.03;

struct controller {
    uint8_t key[AUTHENTICATION_KEY];
    struct authentication_sender sender;
    uint32_t sent;
    bool on;
};

struct run {
    uint64_t chance;
    struct controller controllers[CONTROLLERS];
    struct authentication_receiver receivers[CONTROLLERS];
    struct fl_failover failover;
    uint8_t recorded[RECORDED][MESSAGE];
    size_t recordings;
    int64_t now_ns;
    int64_t taken_ns[CONTROLLERS]; /* when the last message of each was taken */
    uint32_t newest[CONTROLLERS];  /* number of the newest that was taken */
    unsigned taken, refused;
};

/* xorshift64* (Vigna, 2016): the same runs everywhere. */
static uint32_t draw(struct run *run, uint32_t below)
{
    run->chance ^= run->chance >> 12;
    run->chance ^= run->chance << 25;
    run->chance ^= run->chance >> 27;
    return (uint32_t)(run->chance * UINT64_C(2685821657736338717) >> 33) % below;
}

static void start_receiver(struct run *run)
{
    for (size_t i = 0; i < CONTROLLERS; i++)
        authentication_receiver_begin(&run->receivers[i], run->controllers[i].key, PORT);
    fl_failover_begin(&run->failover, run->now_ns);
}

static void switch_on(struct controller *controller)
{
    controller->on = true;
    authentication_sender_begin(&controller->sender, controller->key, PORT);
}

/* A message arrives under the address of a controller. */
static void arrive(struct run *run, size_t rank, const uint8_t message[MESSAGE])
{
    uint8_t challenge[AUTHENTICATION_CHALLENGE];
    uint32_t number;
    memcpy(&number, message + 1, sizeof number);
    enum authentication_verdict verdict =
        authentication_judge(&run->receivers[rank], message, PAYLOAD, message + PAYLOAD, challenge);
    struct controller *controller = &run->controllers[rank];
    if (verdict == AUTHENTICATION_UNANSWERED && controller->on)
        authentication_challenged(&controller->sender, challenge, sizeof challenge);
    if (verdict != AUTHENTICATION_GOOD) {
        run->refused++;
        return;
    }
    /* Each once and in order; the twin may carry one that got lost. */
    if (message[0] != rank || number <= run->newest[rank] || number > controller->sent)
        fail_msg("message %u of %u as that of %zu, after %u", number, message[0], rank, run->newest[rank]);
    run->newest[rank] = number;
    if (!fl_failover_takes(&run->failover, rank, run->now_ns, TIMEOUT_S))
        return;
    if (rank == 1 && run->now_ns - run->taken_ns[0] <= (int64_t)(TIMEOUT_S * 1e9))
        fail_msg("the second controls while the first does");
    run->taken_ns[rank] = run->now_ns;
    run->taken++;
}

static void speak(struct run *run, size_t rank)
{
    struct controller *controller = &run->controllers[rank];
    uint8_t *message = run->recorded[run->recordings++ % RECORDED];
    message[0] = (uint8_t)rank;
    controller->sent++;
    memcpy(message + 1, &controller->sent, sizeof controller->sent);
    authentication_sign(&controller->sender, message, PAYLOAD);
    if (draw(run, 10)) /* a tenth gets lost */
        arrive(run, rank, message);
}

static void attack(struct run *run)
{
    uint8_t message[MESSAGE];
    size_t rank = draw(run, CONTROLLERS);
    for (size_t i = 0; i < MESSAGE; i++)
        message[i] = (uint8_t)draw(run, 256);
    if (run->recordings && draw(run, 4)) {
        size_t kept = run->recordings < RECORDED ? run->recordings : RECORDED;
        memcpy(message, run->recorded[draw(run, (uint32_t)kept)], MESSAGE);
        if (draw(run, 2))
            message[draw(run, MESSAGE)] ^= (uint8_t)(1U << draw(run, 8));
    }
    arrive(run, rank, message);
}

static void step(struct run *run)
{
    run->now_ns += STEP_NS;
    for (size_t rank = 0; rank < CONTROLLERS; rank++) {
        struct controller *controller = &run->controllers[rank];
        if (!draw(run, 100)) {
            if (controller->on)
                controller->on = false;
            else
                switch_on(controller);
        }
        attack(run);
        if (controller->on)
            speak(run, rank);
        attack(run);
    }
    if (!draw(run, 500))
        start_receiver(run);
}

/* Seen to fail where forged or replayed messages are good, where any answer is right or a challenge holds for ever, and
 * with a failover that takes every sender. */
static void one_controls(void **state)
{
    (void)state;
    static struct run run;
    for (uint64_t seed = 1; seed <= RUNS; seed++) {
        run = (struct run){.chance = seed * UINT64_C(0x9E3779B97F4A7C15), .taken_ns = {-STEP_NS * 100}};
        for (size_t rank = 0; rank < CONTROLLERS; rank++) {
            run.controllers[rank].key[0] = (uint8_t)(rank + 1);
            switch_on(&run.controllers[rank]);
        }
        start_receiver(&run);
        for (int i = 0; i < STEPS; i++)
            step(&run);
        if (run.taken < STEPS / 4 || run.refused < 2 * STEPS)
            fail_msg("run %u: %u taken, %u refused", (unsigned)seed, run.taken, run.refused);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(one_controls)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
