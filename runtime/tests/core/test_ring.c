#include "testbed.h"

#include <flotilla/ring.h>
#include <pthread.h>
#include <sched.h>

enum { COUNT = 8, RECORDS = 200 * 1000 };

/* More than a word, so that a record that is read while it is written would show. */
struct record {
    uint64_t number, same, again;
};

static struct fl_ring ring;
static struct record memory[COUNT];

static void keeps_order_and_says_full(void **state)
{
    (void)state;
    struct record record = {0};
    fl_ring_initialize(&ring, memory, sizeof record, COUNT);
    assert_false(fl_ring_take(&ring, &record));
    for (uint64_t i = 0; i < COUNT; i++) {
        record.number = i;
        assert_true(fl_ring_put(&ring, &record));
    }
    assert_false(fl_ring_put(&ring, &record));
    assert_int_equal(ring.lost, 1);
    for (uint64_t i = 0; i < COUNT; i++) {
        assert_true(fl_ring_take(&ring, &record));
        assert_int_equal(record.number, i);
    }
    assert_false(fl_ring_take(&ring, &record));
}

static void *produce(void *unused)
{
    (void)unused;
    for (uint64_t i = 0; i < RECORDS;) {
        struct record record = {i, i, i};
        if (fl_ring_put(&ring, &record))
            i++;
        else
            sched_yield();
    }
    return NULL;
}

/* Under ThreadSanitizer this also proves the order of memory: with relaxed stores it reports a race. */
static void two_threads(void **state)
{
    (void)state;
    pthread_t producer;
    fl_ring_initialize(&ring, memory, sizeof(struct record), COUNT);
    assert_int_equal(pthread_create(&producer, NULL, produce, NULL), 0);
    for (uint64_t i = 0; i < RECORDS;) {
        struct record record;
        if (!fl_ring_take(&ring, &record)) {
            sched_yield();
            continue;
        }
        assert_int_equal(record.number, i);
        assert_int_equal(record.same, i);
        assert_int_equal(record.again, i);
        i++;
    }
    pthread_join(producer, NULL);
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(keeps_order_and_says_full), cmocka_unit_test(two_threads)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
