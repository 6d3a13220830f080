#define _GNU_SOURCE
#include "testbed.h"

#include "core/service.h"

#include <dirent.h>
#include <inttypes.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

/* --- a reader of its own, bit by bit --- */

struct reading {
    char schema[4096];
    uint32_t count;       /* good records */
    uint32_t bad;         /* whole ones with a wrong check */
    size_t rest;          /* bytes after the last whole one */
    size_t bytes;         /* of the file */
    uint64_t first, last; /* their steps */
    double sum;           /* of the double "value" */
};

static uint32_t crc_by_bits(const uint8_t *bytes, size_t count)
{
    uint32_t crc = UINT32_MAX;
    for (size_t i = 0; i < count; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 1 ? crc >> 1 ^ 0xedb88320 : crc >> 1;
    }
    return ~crc;
}

/* For recorders of types "double,int16" with widths "1,2". */
enum { RECORD_BYTES = 20 + 8 + 4 + 4 };

static void read_recording(const char *path, struct reading *reading)
{
    uint32_t sizes[2], check, lost;
    char magic[8];
    uint8_t record[RECORD_BYTES];
    size_t got;
    FILE *file = fopen(path, "rb");
    *reading = (struct reading){0};
    assert_non_null(file);
    assert_int_equal(fread(magic, 1, 8, file), 8);
    assert_memory_equal(magic, "FLOTREC1", 8);
    assert_int_equal(fread(sizes, 4, 2, file), 2);
    assert_int_equal(sizes[1], RECORD_BYTES);
    assert_in_range(sizes[0], 17, sizeof reading->schema);
    assert_int_equal(fread(reading->schema, 1, sizes[0] - 16, file), sizes[0] - 16);
    reading->bytes = sizes[0];
    while ((got = fread(record, 1, RECORD_BYTES, file)) == RECORD_BYTES) {
        uint64_t step;
        double value;
        int16_t pair[2];
        reading->bytes += got;
        memcpy(&check, record + RECORD_BYTES - 4, 4);
        if (check != crc_by_bits(record, RECORD_BYTES - 4)) {
            reading->bad++;
            continue;
        }
        memcpy(&step, record + 8, 8);
        memcpy(&lost, record + 16, 4);
        memcpy(&value, record + 20, 8);
        memcpy(pair, record + 28, 4);
        if (!reading->count)
            reading->first = step;
        assert_int_equal(step, reading->first + reading->count + lost);
        assert_int_equal(pair[0], (int16_t)step);
        assert_int_equal(pair[1], -(int16_t)step);
        assert_near(value, (double)step / 4, 0);
        reading->sum += value;
        reading->last = step;
        reading->count++;
    }
    reading->rest = got;
    fclose(file);
}

/* --- a directory for each test --- */

static char directory[64];

static int make_directory(void **state)
{
    (void)state;
    snprintf(directory, sizeof directory, "/tmp/test_recorder.XXXXXX");
    return mkdtemp(directory) ? 0 : -1;
}

/* The number of files; the paths of the first and the last by name. */
static int list_files(char first[512], char last[512])
{
    struct dirent **entries;
    int count = scandir(directory, &entries, NULL, alphasort), files = 0;
    for (int i = 0; i < count; i++) {
        if (entries[i]->d_name[0] != '.') {
            snprintf(last, 512, "%s/%s", directory, entries[i]->d_name);
            if (files++ == 0)
                memcpy(first, last, 512);
        }
        free(entries[i]);
    }
    free(entries);
    return files;
}

static int remove_directory(void **state)
{
    struct dirent **entries;
    char path[512];
    (void)state;
    int count = scandir(directory, &entries, NULL, NULL);
    for (int i = 0; i < count; i++) {
        snprintf(path, sizeof path, "%s/%s", directory, entries[i]->d_name);
        unlink(path); /* refuses . and .. */
        free(entries[i]);
    }
    free(entries);
    return rmdir(directory);
}

#define RECORDER                                                                                                       \
    "recorder", "directory", directory, "types", "double,int16", "widths", "1,2", "names", "value,pair", "name", "log"

static void record(struct fl_block *recorder, int steps)
{
    for (int i = 0; i < steps; i++) {
        int16_t *pair = testbed_input(recorder, "pair");
        SET(recorder, "value", double, (double)recorder->step / 4);
        pair[0] = (int16_t)recorder->step;
        pair[1] = (int16_t)-pair[0];
        assert_int_equal(testbed_step(recorder), FL_OK);
    }
}

static int open_descriptors(void)
{
    struct dirent **entries;
    int count = scandir("/proc/self/fd", &entries, NULL, NULL);
    for (int i = 0; i < count; i++)
        free(entries[i]);
    free(entries);
    return count;
}

static void records_every_step(void **state)
{
    (void)state;
    char first[512], last[512];
    struct reading reading;
    struct fl_block *recorder = testbed_block(RECORDER, NULL);
    int open_before = open_descriptors();
    testbed_begin(recorder);
    record(recorder, 200);
    assert_int_equal(GET(recorder, "lost", uint32_t), 0);
    assert_true(GET(recorder, "recording", uint8_t));
    testbed_end(recorder);
    assert_int_equal(open_descriptors(), open_before);
    assert_int_equal(list_files(first, last), 1);
    assert_non_null(strstr(first, "/log-000001.rec"));
    read_recording(first, &reading);
    assert_int_equal(reading.count, 200);
    assert_int_equal(reading.bad, 0);
    assert_int_equal(reading.rest, 0);
    assert_int_equal(reading.first, 0);
    assert_near(reading.sum, 199 * 200 / 8.0, 0);
    assert_non_null(strstr(reading.schema, "{\"name\": \"log\", \"period_ns\": 10000000, "));
    assert_non_null(
        strstr(reading.schema, "{\"name\": \"time_ns\", \"type\": \"int64\", \"width\": 1, \"offset\": 0}, "));
    assert_non_null(
        strstr(reading.schema, "{\"name\": \"value\", \"type\": \"double\", \"width\": 1, \"offset\": 20}, "));
    assert_non_null(
        strstr(reading.schema, "{\"name\": \"pair\", \"type\": \"int16\", \"width\": 2, \"offset\": 28}]}"));
}

/* Far more in a burst than 32 places hold: what is missing is counted, and each record tells how many before it. */
static void counts_what_is_lost(void **state)
{
    (void)state;
    char first[512], last[512];
    struct reading reading;
    struct fl_block *recorder = testbed_block(RECORDER, "buffer", "0.2", NULL);
    testbed_begin(recorder);
    record(recorder, 30000);
    while (GET(recorder, "recorded", uint32_t) < 64) /* some after the gap */
        record(recorder, 1);
    uint32_t lost = GET(recorder, "lost", uint32_t);
    uint64_t steps = recorder->step;
    assert_true(lost > 0);
    testbed_end(recorder);
    assert_int_equal(list_files(first, last), 1);
    read_recording(first, &reading);
    assert_int_equal(reading.count + lost, steps);
    assert_int_equal(reading.bad, 0);
}

/* 4096 bytes are about 100 records: 1500 in a buffer make many files, of which the newest three stay. */
static void rotates(void **state)
{
    (void)state;
    char first[512], last[512];
    struct reading oldest, newest;
    for (int run = 0; run < 2; run++) {
        struct fl_block *recorder = testbed_block(RECORDER, "buffer", "20", "file_bytes", "4096", "files", "3", NULL);
        testbed_begin(recorder);
        record(recorder, 1500);
        assert_int_equal(GET(recorder, "lost", uint32_t), 0);
        testbed_end(recorder);
        assert_int_equal(list_files(first, last), 3);
        read_recording(first, &oldest);
        read_recording(last, &newest);
        assert_in_range(oldest.bytes, 4096 - RECORD_BYTES + 1, 4096);
        assert_in_range(newest.bytes, 1, 4096);
        assert_int_equal(newest.last, 1499);
        assert_int_equal(newest.first, oldest.last + 1 + oldest.count);
    }
    /* The second run went on after the numbers of the first. */
    unsigned per_file = oldest.count, files = (1500 + per_file - 1) / per_file;
    char expected[512];
    snprintf(expected, sizeof expected, "%s/log-%06u.rec", directory, 2 * files);
    assert_string_equal(last, expected);
}

/* As many files of earlier runs as nobody expects; the address sanitizer would see a table too small. */
static void keeps_the_newest_of_very_many(void **state)
{
    (void)state;
    char first[512], last[512];
    for (int i = 1; i <= 1100; i++) {
        snprintf(first, sizeof first, "%s/log-%06d.rec", directory, i);
        fclose(fopen(first, "w"));
    }
    struct fl_block *recorder = testbed_block(RECORDER, "files", "1000", NULL);
    testbed_begin(recorder);
    record(recorder, 1);
    testbed_end(recorder);
    assert_int_equal(list_files(first, last), 1000);
    assert_non_null(strstr(first, "/log-000102.rec"));
    assert_non_null(strstr(last, "/log-001101.rec"));
}

static void leaves_the_files_of_others(void **state)
{
    (void)state;
    char first[512], last[512];
    static const char *const others[] = {"log-1.rec", "log-000000.rec", "log-000002.rec.gz", "logs-000001.rec"};
    for (size_t i = 0; i < 4; i++) {
        snprintf(first, sizeof first, "%s/%s", directory, others[i]);
        fclose(fopen(first, "w"));
    }
    struct fl_block *recorder = testbed_block(RECORDER, "files", "1", NULL);
    testbed_begin(recorder);
    record(recorder, 1);
    testbed_end(recorder);
    assert_int_equal(list_files(first, last), 5);
    snprintf(first, sizeof first, "%s/log-000001.rec", directory);
    assert_int_equal(access(first, F_OK), 0);
}

/* A limit of the file's size stands for a full disk: it too takes a part of a write and then refuses. */
static void gives_up_on_a_full_disk(void **state)
{
    (void)state;
    char first[512], last[512];
    struct reading reading;
    struct rlimit before, small;
    getrlimit(RLIMIT_FSIZE, &before);
    small = before;
    small.rlim_cur = 3000;
    struct fl_block *recorder = testbed_block(RECORDER, NULL);
    signal(SIGXFSZ, SIG_IGN);
    setrlimit(RLIMIT_FSIZE, &small);
    testbed_begin(recorder);
    record(recorder, 200);
    while (GET(recorder, "recording", uint8_t))
        record(recorder, 1);
    uint32_t recorded = GET(recorder, "recorded", uint32_t);
    /* It goes on without harm, and counts: all but this step's as soon as the thread has taken what waited. */
    int64_t begin_ns = fl_now_ns();
    record(recorder, 100);
    while (GET(recorder, "lost", uint32_t) + recorded + 1 != recorder->step) {
        record(recorder, 1);
        assert_true(fl_now_ns() - begin_ns < INT64_C(10000000000));
    }
    assert_int_equal(GET(recorder, "recorded", uint32_t), recorded);
    testbed_end(recorder);
    setrlimit(RLIMIT_FSIZE, &before);
    assert_int_equal(list_files(first, last), 1);
    read_recording(first, &reading);
    assert_int_equal(reading.count, recorded);
    assert_int_equal(reading.rest, 0);
    assert_in_range(reading.bytes, 3000 - RECORD_BYTES + 1, 3000);
}

/* Not even the header fits: no file stays. */
static void gives_up_on_a_disk_without_any_room(void **state)
{
    (void)state;
    char first[512], last[512];
    struct rlimit before, none;
    getrlimit(RLIMIT_FSIZE, &before);
    none = before;
    none.rlim_cur = 100;
    struct fl_block *recorder = testbed_block(RECORDER, NULL);
    signal(SIGXFSZ, SIG_IGN);
    setrlimit(RLIMIT_FSIZE, &none);
    testbed_begin(recorder);
    do
        record(recorder, 1);
    while (GET(recorder, "recording", uint8_t));
    testbed_end(recorder);
    setrlimit(RLIMIT_FSIZE, &before);
    assert_int_equal(list_files(first, last), 0);
}

static void is_readable_after_a_kill(void **state)
{
    (void)state;
    char first[512], last[512], byte;
    struct reading reading;
    int ends[2];
    assert_int_equal(pipe(ends), 0);
    pid_t child = fork();
    if (child == 0) {
        struct fl_block *recorder = testbed_block(RECORDER, NULL);
        testbed_begin(recorder);
        for (;;) {
            record(recorder, 1);
            if (GET(recorder, "recorded", uint32_t) >= 50 && write(ends[1], "!", 1) < 0)
                _exit(1);
        }
    }
    close(ends[1]);
    assert_int_equal(read(ends[0], &byte, 1), 1);
    assert_int_equal(kill(child, SIGKILL), 0);
    assert_int_equal(waitpid(child, NULL, 0), child);
    close(ends[0]);
    assert_int_equal(list_files(first, last), 1);
    read_recording(first, &reading);
    assert_true(reading.count >= 50);
    assert_int_equal(reading.bad, 0);
}

/* The policy of this process's thread of that name; -1: there is none. */
static int policy_of(const char *name)
{
    char line[64], path[300], wanted[32];
    int policy = -1;
    snprintf(wanted, sizeof wanted, "%s\n", name);
    DIR *threads = opendir("/proc/self/task");
    assert_non_null(threads);
    for (const struct dirent *thread; (thread = readdir(threads));) {
        snprintf(path, sizeof path, "/proc/self/task/%s/comm", thread->d_name);
        FILE *comm = fopen(path, "r");
        if (!comm)
            continue;
        if (fgets(line, sizeof line, comm) && strcmp(line, wanted) == 0)
            policy = sched_getscheduler(atoi(thread->d_name));
        fclose(comm);
    }
    closedir(threads);
    return policy;
}

/* Whatever the task's priority. */
static void writes_at_ordinary_priority(void **state)
{
    (void)state;
    struct fl_block *recorder = testbed_block(RECORDER, NULL);
    recorder->service->priority = 79;
    testbed_begin(recorder);
    assert_int_equal(policy_of("recorder"), SCHED_OTHER);
    testbed_end(recorder);
}

static void needs_its_directory(void **state)
{
    (void)state;
    struct fl_block *recorder = testbed_block("recorder", "directory", "/nowhere/at/all", "types", "double", NULL);
    assert_int_equal(recorder->type->start(recorder), FL_FAILED);
    assert_string_equal(recorder->service->failure, "cannot open directory /nowhere/at/all: No such file or directory");
    testbed_end(recorder);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("recorder", "directory", "/", "types", "int8", "names", "step", NULL),
                           "names: every record has a step already"));
    assert_non_null(strstr(testbed_refusal("recorder", "directory", "/", "types", "int8", "names", "lost", NULL),
                           "names: there is a port lost already"));
    assert_non_null(strstr(testbed_refusal("recorder", "directory", "/", "types", "int8", "name", "../x", NULL),
                           "name: \"../x\" is not a letter"));
    assert_non_null(
        strstr(testbed_refusal("recorder", "types", "int8", NULL), "parameter directory of recorder is missing"));
    assert_non_null(strstr(testbed_refusal("recorder", "directory", "/", "types", "double,double,double", "widths",
                                           "65536,65536,65536", NULL),
                           "bytes of a record are more than 1048576"));
    assert_non_null(
        strstr(testbed_refusal("recorder", "directory", "/", "types", "double", "widths", "65536", "buffer", "5", NULL),
               "buffer: its records take 268447744 bytes, more than 67108864"));
}

#define IN_DIRECTORY(test) cmocka_unit_test_setup_teardown(test, make_directory, remove_directory)

int main(void)
{
    const struct CMUnitTest tests[] = {
        IN_DIRECTORY(records_every_step),
        IN_DIRECTORY(counts_what_is_lost),
        IN_DIRECTORY(rotates),
        IN_DIRECTORY(keeps_the_newest_of_very_many),
        IN_DIRECTORY(leaves_the_files_of_others),
        IN_DIRECTORY(gives_up_on_a_full_disk),
        IN_DIRECTORY(gives_up_on_a_disk_without_any_room),
        IN_DIRECTORY(is_readable_after_a_kill),
        IN_DIRECTORY(writes_at_ordinary_priority),
        cmocka_unit_test(needs_its_directory),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
