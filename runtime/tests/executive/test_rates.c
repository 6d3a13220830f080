#define _GNU_SOURCE
#include "testbed.h"

#include "core/service.h"
#include "executive/rates.h"

#include <sched.h>
#include <semaphore.h>
#include <stdatomic.h>
#include <stdio.h>
#include <sys/wait.h>
#include <unistd.h>

/* A block with three rates, whose slower ones last as long as a test wants: the order of events decides, no clock. Runs
 * under ThreadSanitizer, too, and had no race (meson setup -Db_sanitize=thread). */

enum { FAST, SLOW, SLOWEST, RATES };

static struct {
    sem_t began[RATES], may_end[RATES];
    _Atomic bool held[RATES];
    char order[256]; /* of runs, where they follow each other */
    unsigned overruns;
    int64_t late_ns;
} test;

struct state {
    double given[RATES], made[RATES];
    unsigned aligned;
};

static void note(int rate)
{
    size_t used = strlen(test.order);
    snprintf(test.order + used, sizeof test.order - used, "%d", rate);
}

static void run(struct fl_block *block, int rate)
{
    struct state *state = block->state;
    double begun_with = state->given[rate];
    sem_post(&test.began[rate]);
    if (atomic_load(&test.held[rate]))
        sem_wait(&test.may_end[rate]);
    if (block->service->rates_in_turn)
        note(rate);
    assert_true(state->given[rate] <= begun_with && state->given[rate] >= begun_with); /* nothing was latched */
    state->made[rate] += state->given[rate];
}

static void run_slow(struct fl_block *block)
{
    run(block, SLOW);
}

static void run_slowest(struct fl_block *block)
{
    run(block, SLOWEST);
}

static void latch_slow(struct fl_block *block)
{
    ((struct state *)block->state)->given[SLOW] = FL_IN(block, 0, double);
}

static void latch_slowest(struct fl_block *block)
{
    ((struct state *)block->state)->given[SLOWEST] = FL_IN(block, 0, double);
}

static void publish_slow(struct fl_block *block)
{
    FL_OUT(block, SLOW, double) = ((struct state *)block->state)->made[SLOW];
}

static void publish_slowest(struct fl_block *block)
{
    FL_OUT(block, SLOWEST, double) = ((struct state *)block->state)->made[SLOWEST];
}

static const struct fl_rate rates[] = {
    {.name = "slow", .every = 2, .publish = publish_slow, .latch = latch_slow, .run = run_slow},
    {.name = "slowest", .every = 6, .publish = publish_slowest, .latch = latch_slowest, .run = run_slowest},
};

static int start(struct fl_block *block)
{
    return fl_rates_start(block, rates, 2);
}

static int step(struct fl_block *block)
{
    struct state *state = block->state;
    if (fl_rates_begin(block) != FL_OK)
        return FL_FAILED;
    state->aligned += fl_rates_aligned(block);
    if (block->service->rates_in_turn)
        note(FAST);
    FL_OUT(block, FAST, double) = FL_IN(block, 0, double);
    fl_rates_release(block);
    return FL_OK;
}

static const struct fl_port inputs[] = {{.name = "in", .type = FL_DOUBLE, .width = 1}};
static const struct fl_port outputs[] = {{.name = "fast", .type = FL_DOUBLE, .width = 1},
                                         {.name = "slow", .type = FL_DOUBLE, .width = 1},
                                         {.name = "slowest", .type = FL_DOUBLE, .width = 1}};

FL_BLOCK(three_rates) = {
    .abi = FL_ABI,
    .name = "three-rates",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    .state_size = sizeof(struct state),
    .start = start,
    .step = step,
    .terminate = fl_rates_stop,
};

static void overran(void *context, int64_t late_ns)
{
    (void)context;
    test.overruns++;
    test.late_ns = late_ns;
}

static struct fl_block *made(bool in_turn, int64_t permitted)
{
    memset(&test, 0, sizeof test);
    for (int i = 0; i < RATES; i++) {
        sem_init(&test.began[i], 0, 0);
        sem_init(&test.may_end[i], 0, 0);
    }
    struct fl_block *block = testbed_block("three-rates", NULL);
    block->service->rates_in_turn = in_turn;
    block->service->overruns = permitted;
    block->service->overran = overran;
    return block;
}

static int step_with(struct fl_block *block, double in)
{
    SET(block, "in", double, in);
    return testbed_step(block);
}

static void let_end(int rate)
{
    atomic_store(&test.held[rate], false);
    sem_post(&test.may_end[rate]);
}

/* Until a slower rate has ended. */
static void await_end(const struct fl_block *block, int rate)
{
    while (rates_run(block, (uint32_t)rate - 1))
        sched_yield();
}

static void steps_go_on_while_a_slower_rate_runs(void **state)
{
    (void)state;
    struct fl_block *block = made(false, 1);
    const struct state *own = block->state;
    testbed_begin(block);
    atomic_store(&test.held[SLOWEST], true);
    for (int i = 0; i < 6; i++) { /* the slowest lasts for all of them */
        assert_int_equal(step_with(block, i + 1), FL_OK);
        assert_near(GET(block, "fast", double), i + 1, 0);
        if (i == 0)
            sem_wait(&test.began[SLOWEST]);
        if (i % 2 == 0) {
            sem_wait(&test.began[SLOW]);
            await_end(block, SLOW);
            assert_int_equal(sem_trywait(&test.began[SLOW]), -1); /* it ran once */
        }
        assert_near(GET(block, "slowest", double), 0, 0);
    }
    assert_int_equal(own->aligned, 1);
    assert_int_equal(test.overruns, 0);
    let_end(SLOWEST);
    await_end(block, SLOWEST);
    fl_rates_stop(block);
    assert_near(own->made[SLOWEST], 1, 0); /* what was latched at its release */
    assert_near(own->made[SLOW], 1 + 3 + 5, 0);
    testbed_end(block);
}

static void in_turn_a_step_ends_with_the_slower_ones_and_their_outputs_come_at_the_next_release(void **state)
{
    (void)state;
    struct fl_block *block = made(true, 1);
    double slow = 0, slowest = 0;
    testbed_begin(block);
    for (int i = 0; i < 13; i++) {
        assert_int_equal(step_with(block, i + 1), FL_OK);
        if (i % 2 == 0 && i)
            slow += i - 1; /* what the run before was given */
        if (i % 6 == 0 && i)
            slowest += i - 5;
        assert_near(GET(block, "slow", double), slow, 0);
        assert_near(GET(block, "slowest", double), slowest, 0);
    }
    assert_string_equal(test.order, "012"
                                    "001"
                                    "001"
                                    "0012"
                                    "001"
                                    "001"
                                    "0012");
    assert_int_equal(((struct state *)block->state)->aligned, 3);
    testbed_end(block);
}

static void overruns_are_counted_and_the_release_is_left_out(void **state)
{
    (void)state;
    struct fl_block *block = made(false, 0); /* any number */
    testbed_begin(block);
    atomic_store(&test.held[SLOW], true);
    assert_int_equal(step_with(block, 1), FL_OK);
    sem_wait(&test.began[SLOW]);
    for (int i = 0; i < 4; i++)
        assert_int_equal(step_with(block, 10), FL_OK);
    assert_int_equal(test.overruns, 2);
    assert_near(GET(block, "slow", double), 0, 0);
    let_end(SLOW);
    await_end(block, SLOW);
    await_end(block, SLOWEST);
    for (int i = 0; i < 2; i++)
        assert_int_equal(step_with(block, 0), FL_OK);
    assert_int_equal(test.overruns, 2);
    assert_near(GET(block, "slow", double), 1, 0);
    testbed_end(block);
}

static void as_many_in_a_row_as_permitted_end_the_task(void **state)
{
    (void)state;
    struct fl_block *block = made(false, 2);
    testbed_begin(block);
    atomic_store(&test.held[SLOW], true);
    for (int i = 0; i < 4; i++)
        assert_int_equal(step_with(block, 1), FL_OK);
    assert_false(block->service->overrun_ends);
    assert_int_equal(step_with(block, 1), FL_FAILED);
    assert_true(block->service->overrun_ends);
    assert_string_equal(block->service->failure, "slow still ran when it was due again, 2 times in a row");
    let_end(SLOW);
    testbed_end(block);
}

/* What a process that ends says, and its status. */
static int last_words(void (*action)(struct fl_block *block), char *words, size_t size)
{
    int ends[2], status;
    assert_int_equal(pipe(ends), 0);
    pid_t child = fork();
    if (!child) {
        dup2(ends[1], STDERR_FILENO);
        struct fl_block *block = made(false, 0);
        testbed_begin(block);
        atomic_store(&test.held[SLOW], true);
        block->release_ns = fl_now_ns() - INT64_C(1000000000000);
        step_with(block, 1);
        sem_wait(&test.began[SLOW]);
        action(block);
        _exit(0);
    }
    close(ends[1]);
    /* A line may be written in parts. */
    size_t length = 0;
    for (ssize_t part; (part = read(ends[0], words + length, size - 1 - length)) > 0;)
        length += (size_t)part;
    words[length] = '\0';
    close(ends[0]);
    waitpid(child, &status, 0);
    return WIFEXITED(status) ? WEXITSTATUS(status) : -1;
}

static void two_steps(struct fl_block *block)
{
    step_with(block, 1);
    step_with(block, 1);
}

static void a_rate_that_hangs_ends_the_process(void **state)
{
    (void)state;
    char words[256];
    assert_int_equal(last_words(two_steps, words, sizeof words), 1);
    assert_ptr_equal(strstr(words, "flotilla: three-rates: slow hangs, "), words);
    assert_non_null(strstr(words, "s after its release; no task runs\n"));
    assert_int_equal(last_words(fl_rates_stop, words, sizeof words), 1);
    assert_ptr_equal(strstr(words, "flotilla: three-rates: slow did not end with the task, "), words);
}

/* Also under a task with 80, whose drivers have 79: serial ports have 70, CAN 65, the network 60. */
static void rates_run_below_the_interrupts_of_devices(void **state)
{
    (void)state;
    assert_int_equal(rates_priority(79, 0), 59);
    assert_int_equal(rates_priority(79, 1), 58);
    assert_int_equal(rates_priority(60, 0), 59);
    assert_int_equal(rates_priority(50, 0), 49);
    assert_int_equal(rates_priority(50, 48), 1);
    assert_true(rates_priority(50, 49) < 0);
    assert_true(rates_priority(1, 0) < 0);
    assert_int_equal(rates_priority(0, 3), 0);
}

static void a_priority_without_room_below_is_refused(void **state)
{
    (void)state;
    struct fl_block *block = made(false, 1);
    block->service->priority = 2; /* of drivers: the task's is one above */
    assert_int_equal(start(block), FL_FAILED);
    assert_string_equal(block->service->failure,
                        "2 slower rates need a priority each below the task's, which is 3; give it 4 or more");
    testbed_end(block);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(steps_go_on_while_a_slower_rate_runs),
        cmocka_unit_test(in_turn_a_step_ends_with_the_slower_ones_and_their_outputs_come_at_the_next_release),
        cmocka_unit_test(overruns_are_counted_and_the_release_is_left_out),
        cmocka_unit_test(as_many_in_a_row_as_permitted_end_the_task),
        cmocka_unit_test(a_rate_that_hangs_ends_the_process),
        cmocka_unit_test(rates_run_below_the_interrupts_of_devices),
        cmocka_unit_test(a_priority_without_room_below_is_refused),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
