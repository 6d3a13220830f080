#define _GNU_SOURCE
#include "testbed.h"

#include "executive/block.h"
#include "executive/status.h"

#include <flotilla/sensor.h>
#include <inttypes.h>
#include <pthread.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdlib.h>

enum { READINGS = 200, LINE_BYTES = 1024 };

#define PATIENCE_NS INT64_C(60000000000)

static const struct fl_port sensor_ports[] = {{.name = "rate", .type = FL_DOUBLE, .width = 1}, FL_SENSOR_OUTPUTS};
static const struct fl_block_type sensor_type = {.name = "gyro", FL_TABLE(output, sensor_ports)};
/* Has a flag, but not what makes a sensor. */
static const struct fl_port other_ports[] = {{.name = "flag", .type = FL_BOOLEAN, .width = 1},
                                             {.name = "age", .type = FL_DOUBLE, .width = 1}};
static const struct fl_block_type other_type = {.name = "other", FL_TABLE(output, other_ports)};

static struct task_block blocks[2];
static struct task task = {.name = "heading", .period_ns = 10000000, .blocks = blocks, .count = 2};

static int prepare(void **state)
{
    (void)state;
    blocks[0].block = block_create(&other_type, "camera");
    blocks[1].block = block_create(&sensor_type, "gyro");
    return block_make_signals(blocks[0].block) || block_make_signals(blocks[1].block);
}

static int clear(void **state)
{
    (void)state;
    block_destroy(blocks[0].block);
    block_destroy(blocks[1].block);
    return 0;
}

static void set_sensor(bool flag, double age)
{
    FL_OUT(blocks[1].block, 1, bool) = flag;
    FL_OUT(blocks[1].block, 2, double) = age;
}

static void write_line(const struct status *status, bool json, char *line)
{
    FILE *out = fmemopen(line, LINE_BYTES, "w");
    assert_non_null(out);
    status_write(status, json, out);
    assert_int_equal(fclose(out), 0);
}

static uint64_t number_after(const char *line, const char *key)
{
    const char *at = strstr(line, key);
    assert_non_null(at);
    return strtoull(at + strlen(key), NULL, 10);
}

static void what_was_put_is_written(void **state)
{
    (void)state;
    char line[LINE_BYTES];
    struct status *status = status_create(&task);
    struct run_result result = {.steps = 1, .timeouts = 4};
    set_sensor(false, 0.25);
    status_put(status, &result, fl_now_ns());
    write_line(status, true, line);
    assert_non_null(strstr(line, "{\"task\": \"heading\", \"period_s\": 0.01, \"running_s\": 0."));
    assert_non_null(
        strstr(line, "\"steps\": 1, \"overruns\": 0, \"skipped\": 0, \"timeouts\": 4, \"last_overrun\": null"));
    assert_non_null(strstr(line, "\"sensors\": {\"gyro\": {\"flag\": false, \"age_s\": 0.250000}}}\n"));

    result = (struct run_result){.steps = 9, .overruns = 2, .skipped = 3, .last_overrun = {7, fl_now_ns(), 1500000}};
    set_sensor(true, 0.004);
    status_put(status, &result, fl_now_ns());
    assert_int_equal(status_steps(status), 9);
    write_line(status, true, line);
    assert_non_null(strstr(line, "\"overruns\": 2, \"skipped\": 3"));
    assert_non_null(strstr(line, "\"last_overrun\": {\"step\": 7, \"ago_s\": 0."));
    assert_non_null(
        strstr(line, "\"late_s\": 0.001500000}, \"sensors\": {\"gyro\": {\"flag\": true, \"age_s\": 0.004000}}}"));
    write_line(status, false, line);
    assert_non_null(strstr(line, "period: 0.01 s\n"));
    assert_non_null(strstr(line, "overruns: 2, 3 releases skipped; the last 0."));
    assert_non_null(strstr(line, "s ago: step 7 ended 0.001500 s late\n"));
    assert_non_null(strstr(line, "\ngyro: flag 1, age 0.004 s\n"));
    assert_null(strstr(line, "camera"));
    status_destroy(status);
}

static _Atomic bool done;

static void *control(void *argument)
{
    struct status *status = argument;
    for (uint64_t n = 1; !atomic_load(&done); n++) {
        struct run_result result = {.steps = n, .overruns = n, .skipped = n, .timeouts = n, .last_overrun = {n, 0, 0}};
        set_sensor(n % 2, (double)(n % 1000));
        status_put(status, &result, fl_now_ns());
    }
    return NULL;
}

/* All numbers of a reading are of one step. Under ThreadSanitizer this also proves the order of memory. Seen to fail
 * where the reader does not look at the turn. */
static void a_reading_is_of_one_step(void **state)
{
    (void)state;
    static const char *const keys[] = {"\"overruns\": ", "\"skipped\": ", "\"timeouts\": ", "{\"step\": "};
    char line[LINE_BYTES];
    pthread_t thread;
    uint64_t last = 0;
    int64_t end_ns = fl_now_ns() + PATIENCE_NS;
    struct status *status = status_create(&task);
    struct run_result first = {.steps = 1, .overruns = 1, .skipped = 1, .timeouts = 1, .last_overrun = {1, 0, 0}};
    set_sensor(true, 1);
    status_put(status, &first, fl_now_ns());
    assert_int_equal(pthread_create(&thread, NULL, control, status), 0);
    for (unsigned other = 0; other < READINGS; sched_yield()) {
        assert_true(fl_now_ns() < end_ns);
        write_line(status, true, line);
        uint64_t steps = number_after(line, "\"steps\": ");
        other += steps != last;
        last = steps;
        for (size_t key = 0; key < sizeof keys / sizeof *keys; key++)
            if (number_after(line, keys[key]) != steps)
                fail_msg("of step %" PRIu64 ": %s", steps, line);
        if (number_after(line, "\"age_s\": ") != steps % 1000)
            fail_msg("of step %" PRIu64 ": %s", steps, line);
    }
    atomic_store(&done, true);
    pthread_join(thread, NULL);
    status_destroy(status);
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(what_was_put_is_written),
                                       cmocka_unit_test(a_reading_is_of_one_step)};
    return cmocka_run_group_tests(tests, prepare, clear);
}
