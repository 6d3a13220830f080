/* The triple buffer; apart from the blocks' tests, so that ThreadSanitizer can watch it. */
#include "core/newest.h"

#include "testbed.h"

#include <pthread.h>

enum { RECORDS = 100 * 1000, WORDS = 64 };

struct record {
    uint32_t words[WORDS];
};

static struct newest newest;
static struct record memory[NEWEST_SLOTS];

static void begin(void)
{
    newest_begin(&newest);
    for (int i = 0; i < NEWEST_SLOTS; i++)
        newest.slots[i] = &memory[i];
}

static void put(uint32_t value)
{
    struct record *record = newest_back(&newest);
    for (int i = 0; i < WORDS; i++)
        record->words[i] = value;
    newest_put(&newest);
}

static void *produce(void *unused)
{
    (void)unused;
    for (uint32_t i = 1; i <= RECORDS; i++)
        put(i);
    return NULL;
}

static void leaves_alone_what_is_read(void **state)
{
    (void)state;
    begin();
    put(1);
    const struct record *read = newest_take(&newest);
    for (uint32_t i = 2; i < 8; i++) {
        put(i);
        assert_int_equal(read->words[0], 1);
    }
    read = newest_take(&newest);
    assert_int_equal(read->words[0], 7);
}

/* No record is seen half, twice or out of order, and the last one arrives. */
static void hands_records_over(void **state)
{
    (void)state;
    pthread_t producer;
    begin();
    assert_null(newest_take(&newest));
    assert_int_equal(pthread_create(&producer, NULL, produce, NULL), 0);
    for (uint32_t last = 0; last < RECORDS;) {
        const struct record *record = newest_take(&newest);
        if (!record)
            continue;
        assert_true(record->words[0] > last);
        last = record->words[0];
        for (int i = 0; i < WORDS; i++)
            assert_int_equal(record->words[i], last);
    }
    assert_null(newest_take(&newest));
    pthread_join(producer, NULL);
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(leaves_alone_what_is_read),
                                       cmocka_unit_test(hands_records_over)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
