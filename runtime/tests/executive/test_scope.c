#define _GNU_SOURCE
#include "testbed.h"

#include "executive/scope.h"

#include <pthread.h>
#include <sched.h>
#include <stdlib.h>

enum { ROUNDS = 3000, LARGE_ROUNDS = 30, LINE_BYTES = 256 };

static struct scope scope;
static uint64_t counted;
static const struct watched table[] = {{.name = "a.count", .signal = &counted, .type = FL_UINT64, .width = 1}};
static _Atomic bool done;
static _Atomic uint64_t steps;

static void *control(void *unused)
{
    (void)unused;
    for (uint64_t step = 0; !atomic_load(&done); step++) {
        counted = 3 * step;
        scope_put(&scope, step, (int64_t)(10 * step));
        atomic_store(&steps, step + 1);
        sched_yield();
    }
    return NULL;
}

static void line_of(const struct sampler *sampler, const struct row *row, bool csv, char *line)
{
    FILE *out = fmemopen(line, LINE_BYTES, "w");
    assert_non_null(out);
    (csv ? sampler_write_csv : sampler_write)(sampler, row, out);
    assert_int_equal(fclose(out), 0);
}

/* Step and value of a row; the release belongs to the same step. */
static void read_row(const struct sampler *sampler, const struct row *row, uint64_t *step, uint64_t *value)
{
    char line[LINE_BYTES];
    long long release;
    unsigned long long first, last;
    line_of(sampler, row, true, line);
    /* NOLINTNEXTLINE(cert-err34-c): the line is ours */
    assert_int_equal(sscanf(line, "%llu,%lld,%*u,%llu", &first, &release, &last), 3);
    assert_int_equal(release, (long long)(10 * first));
    *step = first;
    *value = last;
}

/* A client that comes and goes at any moment sees whole rows, one for each step in a row. Seen to fail without the
 * first row's step aligned. */
static void clients_come_and_go(void **state)
{
    (void)state;
    pthread_t thread;
    atomic_store(&done, false);
    assert_int_equal(pthread_create(&thread, NULL, control, NULL), 0);
    for (uint32_t round = 0; round < ROUNDS; round++) {
        uint32_t every = 1 + round % 3;
        struct sampler *sampler = sampler_create(table, 1);
        struct scope_slot *slot = scope_attach(&scope, sampler, every);
        assert_non_null(slot);
        for (uint64_t until = atomic_load(&steps) + round % 9; atomic_load(&steps) < until;)
            sched_yield();
        scope_detach(slot);
        uint64_t last = 0, step, value, rows = 0;
        for (const struct row *row; (row = sampler_take(sampler)); rows++, last = step) {
            read_row(sampler, row, &step, &value);
            assert_int_equal(value, 3 * step);
            assert_int_equal(step % every, 0);
            if (rows)
                assert_int_equal(step, last + every);
        }
        sampler_destroy(sampler);
    }
    atomic_store(&done, true);
    pthread_join(thread, NULL);
}

static void *copy_always(void *unused)
{
    (void)unused;
    while (!atomic_load(&done))
        scope_put(&scope, 0, 0);
    return NULL;
}

/* Most of the time a row is being copied when the client goes; AddressSanitizer sees a write to memory that is gone.
 * Seen to fail with a detachment that does not wait for the copy. */
static void nothing_is_copied_for_a_client_that_has_gone(void **state)
{
    (void)state;
    static double wide[1024];
    static const struct watched large[] = {{.name = "a.wide", .signal = wide, .type = FL_DOUBLE, .width = 1024}};
    pthread_t thread;
    atomic_store(&done, false);
    assert_int_equal(pthread_create(&thread, NULL, copy_always, NULL), 0);
    for (uint32_t round = 0; round < LARGE_ROUNDS; round++) {
        struct sampler *sampler = sampler_create(large, 1);
        struct scope_slot *slot = scope_attach(&scope, sampler, 1);
        while (!sampler_take(sampler))
            sched_yield();
        scope_detach(slot);
        sampler_destroy(sampler);
    }
    atomic_store(&done, true);
    pthread_join(thread, NULL);
}

static void slots_are_few(void **state)
{
    (void)state;
    struct sampler *sampler = sampler_create(table, 1);
    struct scope_slot *slots[SCOPE_CLIENTS];
    for (size_t i = 0; i < SCOPE_CLIENTS; i++)
        assert_non_null(slots[i] = scope_attach(&scope, sampler, 1));
    assert_null(scope_attach(&scope, sampler, 1));
    scope_detach(slots[1]);
    assert_ptr_equal(scope_attach(&scope, sampler, 1), slots[1]);
    for (size_t i = 0; i < SCOPE_CLIENTS; i++)
        scope_detach(slots[i]);
    sampler_destroy(sampler);
}

/* A full sampler drops rows and counts them in the next one that has room. */
static void what_has_no_room_is_counted(void **state)
{
    (void)state;
    char line[LINE_BYTES];
    struct sampler *sampler = sampler_create(table, 1);
    counted = 0;
    uint64_t put = 0, taken = 0;
    for (; put < 1034; put++)
        sampler_put(sampler, put, 0, false);
    while (sampler_take(sampler))
        taken++;
    assert_int_equal(taken, 1024);
    sampler_put(sampler, put, 7, false);
    line_of(sampler, sampler_take(sampler), false, line);
    assert_string_equal(line, "{\"step\": 1034, \"release_ns\": 7, \"lost\": 10, \"a.count\": 0}\n");
    sampler_destroy(sampler);
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(clients_come_and_go),
                                       cmocka_unit_test(nothing_is_copied_for_a_client_that_has_gone),
                                       cmocka_unit_test(slots_are_few), cmocka_unit_test(what_has_no_room_is_counted)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
