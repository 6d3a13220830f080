#include "testbed.h"

#include "executive/change.h"

#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <sys/eventfd.h>

enum { OFFERS = 20000 };

/* Both halves are the same number, so that a value that is half the old one would show. */
static uint64_t doubled(uint32_t number)
{
    return (uint64_t)number << 32 | number;
}

static struct change change;
static uint64_t parameter;
static _Atomic bool done, torn;
static uint64_t seen_since[OFFERS + 1], told_since[OFFERS + 1]; /* step, 1 more, by number; 0: never */

static void *control(void *unused)
{
    (void)unused;
    uint32_t last = 0;
    for (uint64_t step = 0; !atomic_load(&done); step++) {
        change_take(&change, step);
        uint32_t number = (uint32_t)parameter;
        if (parameter != doubled(number))
            atomic_store(&torn, true);
        if (number != last)
            seen_since[number] = step + 1;
        last = number;
        sched_yield();
    }
    return NULL;
}

/* What is reported is what happened, to the step, whether a change was taken or withdrawn. Under ThreadSanitizer this
 * also proves the order of memory. Seen to fail when neither side compares (it waits for ever), and with relaxed
 * stores. */
static void a_change_is_taken_at_the_step_that_is_told_or_never(void **state)
{
    (void)state;
    pthread_t thread;
    unsigned withdrawn = 0;
    parameter = 0;
    assert_int_equal(change_initialize(&change), 0);
    assert_int_equal(pthread_create(&thread, NULL, control, NULL), 0);
    for (uint32_t number = 1; number <= OFFERS; number++) {
        uint64_t value = doubled(number), step;
        change_offer(&change, &parameter, &value, sizeof value);
        for (uint32_t i = number % 8; i < 4; i++)
            sched_yield();
        if (number % 2 && change_withdraw(&change)) {
            withdrawn++;
            continue;
        }
        while (!change_taken(&change, &step))
            poll(&(struct pollfd){.fd = change.taken_fd, .events = POLLIN}, 1, -1);
        told_since[number] = step + 1;
    }
    atomic_store(&done, true);
    pthread_join(thread, NULL);
    change_clear(&change);
    assert_false(atomic_load(&torn));
    assert_in_range(withdrawn, 1, OFFERS);
    for (uint32_t number = 1; number <= OFFERS; number++)
        if (told_since[number] != seen_since[number])
            fail_msg("change %u: reported for step %lld, seen in step %lld", (unsigned)number,
                     (long long)told_since[number] - 1, (long long)seen_since[number] - 1);
}

/* Even if nobody ever read that something was taken. Seen to fail, by the time limit, with an eventfd that blocks. */
static void taking_does_not_wait(void **state)
{
    (void)state;
    uint64_t value = doubled(1), step = 0;
    parameter = 0;
    assert_int_equal(change_initialize(&change), 0);
    change_take(&change, 6);
    assert_int_equal(parameter, 0);
    assert_int_equal(eventfd_write(change.taken_fd, UINT64_MAX - 1), 0);
    change_offer(&change, &parameter, &value, sizeof value);
    change_take(&change, 7);
    assert_int_equal(parameter, value);
    assert_false(change_withdraw(&change));
    assert_true(change_taken(&change, &step));
    assert_int_equal(step, 7);
    assert_false(change_taken(&change, &step));
    change_clear(&change);
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(taking_does_not_wait),
                                       cmocka_unit_test(a_change_is_taken_at_the_step_that_is_told_or_never)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
