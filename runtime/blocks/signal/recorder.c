/** recorder
 *
 * Records signals in files, as records of a fixed size. The step puts a record into a buffer; a thread of ordinary
 * priority writes it. make convert and make report read the files.
 *
 * A file NAME-000001.rec, all little-endian, is a header and then records until its end:
 *
 *   "FLOTREC1"        8 bytes
 *   header, record    uint32 each: bytes of the header, these 16 included, and of a record
 *   schema            JSON, padded with spaces: name, period_ns, wall_less_monotonic_ns (when the file was begun),
 *                     and fields, each with name, type, width, offset in the record
 *
 *   time_ns           int64: when the step was due, CLOCK_MONOTONIC
 *   step              uint64
 *   lost              uint32: records lost before this one
 *   the signals, without gaps
 *   check             uint32: CRC-32 (IEEE 802.3, as zlib's) of all before it
 *
 * Failure: No step waits for the disk. A record for which the buffer has no room is lost, and counted in `lost`. When
 * the disk is full or fails, `recording` becomes 0, the journal says why, and the task goes on. A directory that is
 * not there fails the start. Records are written whole, so a killed writer leaves none partial; after a loss of power
 * the check tells which are good.
 */
#define _GNU_SOURCE
#include "core/wall_clock.h"
#include "layout.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <flotilla/driver.h>
#include <inttypes.h>
#include <math.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { RECORDING, RECORDED, LOST };
enum { TIME_AT = 0, STEP_AT = 8, LOST_AT = 16, SIGNALS_AT = 20, CHECK_BYTES = 4, PREFIX = 16 };

enum {
    WAKE_MS = 50, /* period of the writer: waking it in every step would cost the step a system call */
    BATCH_BYTES = 64 * 1024,
    MOST_FILES = 1000,
    MOST_BYTES = 1 << 20,  /* of a record */
    MOST_MEMORY = 1 << 26, /* bytes of all that wait */
    NAME_BYTES = 64,       /* of a file's name, without its number */
    FILE_BYTES = NAME_BYTES + 16,
};

/* The default buffer is two seconds: a card may be busy with a write for half a second (SD Physical Layer
 * Specification, 4.6.2.2), a sync writes more than once, and the writer, at ordinary priority, runs after all that is
 * urgent. */
struct recorder {
    LAYOUT_MEMBERS;
    const char *directory, *name;
    int64_t file_bytes, files;
    double buffer, sync;
};

/* The writer thread's own. */
struct writer {
    int fd; /* -1: none, or no longer */
    int64_t written, synced_ns;
    bool unsynced;
    uint32_t next;     /* number of the next file */
    uint32_t *numbers; /* of the files there are, oldest first */
    uint32_t file_count;
    uint8_t *batch;
    uint32_t batch_records;
    char *header;
    size_t header_bytes;
};

struct state {
    struct fl_block *block;
    struct layout layout;
    size_t record_bytes;
    const char *name;
    int directory; /* -1: not open */
    struct fl_driver *driver;
    struct fl_ring ring;
    uint8_t *record; /* the step's own */
    _Atomic bool recording;
    _Atomic uint32_t recorded, unwritten;
    struct writer writer;
};

static const struct fl_parameter parameters[] = {
    LAYOUT_PARAMETERS(struct recorder),
    FL_PARAMETER(struct recorder, directory, .summary = "where the files go; it must be there"),
    FL_PARAMETER(struct recorder, name, .default_value = "",
                 .summary = "what the files begin with; without: the block's"),
    FL_PARAMETER(struct recorder, file_bytes, .default_value = "16777216", .min = 4096, .max = 2147483647,
                 .unit = "byte", .summary = "of a file, then the next is begun"),
    FL_PARAMETER(struct recorder, files, .default_value = "8", .min = 1, .max = MOST_FILES,
                 .summary = "that are kept, those of earlier runs included: the oldest goes when a new one is begun"),
    FL_PARAMETER(struct recorder, buffer, .default_value = "2", .min = 0.2, .max = 600, .unit = "s",
                 .summary = "of records that wait in memory while the disk or the processor is busy"),
    FL_PARAMETER(struct recorder, sync, .default_value = "5", .min = 0, .max = 3600, .unit = "s",
                 .summary = "how much is lost at most when power goes; 0: as much as the system buffers"),
};

static const struct fl_port outputs[] = {
    {.name = "recording", .type = FL_BOOLEAN, .width = 1, .summary = "0: stopped, because the disk is full or faulty"},
    {.name = "recorded", .type = FL_UINT32, .width = 1, .summary = "records written so far"},
    {.name = "lost", .type = FL_UINT32, .width = 1, .summary = "records lost so far"},
};

static const char *file_name(const struct fl_block *block)
{
    const struct recorder *recorder = block->parameters;
    return *recorder->name ? recorder->name : block->name;
}

static int make_layout(struct fl_block *block, struct layout *layout)
{
    const struct recorder *recorder = block->parameters;
    if (layout_make(block, LAYOUT(recorder), "in", SIGNALS_AT, 1, layout) != FL_OK)
        return FL_FAILED;
    if (layout->bytes > MOST_BYTES)
        return fl_fail(block, "%zu bytes of a record are more than %d", layout->bytes, MOST_BYTES);
    for (uint32_t i = 0; i < layout->count; i++)
        if (strcmp(layout->fields[i].name, "time_ns") == 0 || strcmp(layout->fields[i].name, "step") == 0)
            return fl_fail(block, "names: every record has a %s already", layout->fields[i].name);
    return FL_OK;
}

static uint32_t buffered_records(const struct fl_block *block)
{
    const struct recorder *recorder = block->parameters;
    double wanted = recorder->buffer * 1e9 / (double)block->period_ns;
    uint32_t count = 2;
    while (count < wanted && count < 1u << 24)
        count *= 2;
    return count;
}

static int configure(struct fl_block *block)
{
    const char *name = file_name(block);
    struct layout layout;
    if (!layout_is_name(name) || strlen(name) >= NAME_BYTES)
        return fl_fail(block, "name: \"%s\" is not a letter, then letters, digits, _ or -, less than %d in all", name,
                       NAME_BYTES);
    if (make_layout(block, &layout) != FL_OK)
        return FL_FAILED;
    double memory = (double)buffered_records(block) * (double)(layout.bytes + CHECK_BYTES);
    if (memory > MOST_MEMORY)
        return fl_fail(block, "buffer: its records take %.0f bytes, more than %d", memory, MOST_MEMORY);
    return layout_add_ports(block, &layout, fl_add_input, "is recorded");
}

/* --- files --- */

static void name_file(const struct state *state, uint32_t number, char name[FILE_BYTES])
{
    snprintf(name, FILE_BYTES, "%s-%06" PRIu32 ".rec", state->name, number);
}

/* The number of a file of this recorder, or 0. */
static uint32_t file_number(const struct state *state, const char *file)
{
    size_t stem = strlen(state->name);
    if (strncmp(file, state->name, stem) != 0 || file[stem] != '-')
        return 0;
    char *end, name[FILE_BYTES];
    unsigned long number = strtoul(file + stem + 1, &end, 10);
    if (number == 0 || number >= UINT32_MAX)
        return 0;
    name_file(state, (uint32_t)number, name);
    return strcmp(file, name) == 0 ? (uint32_t)number : 0;
}

static void remove_oldest(struct state *state)
{
    struct writer *writer = &state->writer;
    char name[FILE_BYTES];
    name_file(state, writer->numbers[0], name);
    unlinkat(state->directory, name, 0);
    memmove(writer->numbers, writer->numbers + 1, --writer->file_count * sizeof *writer->numbers);
}

/* Keep a file's number in order. Beyond `files` the oldest is removed. */
static void know_file(struct state *state, uint32_t number, int64_t files)
{
    struct writer *writer = &state->writer;
    uint32_t at = writer->file_count;
    while (at > 0 && writer->numbers[at - 1] > number)
        at--;
    memmove(writer->numbers + at + 1, writer->numbers + at, (writer->file_count - at) * sizeof *writer->numbers);
    writer->numbers[at] = number;
    writer->file_count++;
    if (number >= writer->next)
        writer->next = number + 1;
    while (writer->file_count > files)
        remove_oldest(state);
}

/* The files of earlier runs. */
static int find_files(struct fl_block *block, struct state *state)
{
    const struct recorder *recorder = block->parameters;
    int fd = dup(state->directory);
    DIR *directory = fd < 0 ? NULL : fdopendir(fd);
    if (!directory) {
        close(fd);
        return fl_fail(block, "cannot read directory %s: %s", recorder->directory, strerror(errno));
    }
    for (const struct dirent *entry; (entry = readdir(directory));) {
        uint32_t number = file_number(state, entry->d_name);
        if (number)
            know_file(state, number, recorder->files);
    }
    closedir(directory);
    return FL_OK;
}

/* --- header --- */

/* Printed to `out` as far as it fits; its length in any case. */
static size_t write_schema(const struct state *state, int64_t wall_less_monotonic, char *out, size_t size)
{
    static const struct layout_field own[] = {
        {"time_ns", FL_INT64, 1, TIME_AT}, {"step", FL_UINT64, 1, STEP_AT}, {"lost", FL_UINT32, 1, LOST_AT}};
    enum { OWN = sizeof own / sizeof own[0] };
    size_t used = 0;
#define ADD(...) used += (size_t)snprintf(out + (used < size ? used : size), used < size ? size - used : 0, __VA_ARGS__)
    ADD("{\"name\": \"%s\", \"period_ns\": %" PRId64 ", \"wall_less_monotonic_ns\": %" PRId64 ", \"fields\": [",
        state->name, state->block->period_ns, wall_less_monotonic);
    for (uint32_t i = 0; i < OWN + state->layout.count; i++) {
        const struct layout_field *field = i < OWN ? &own[i] : &state->layout.fields[i - OWN];
        ADD("%s{\"name\": \"%s\", \"type\": \"%s\", \"width\": %" PRIu32 ", \"offset\": %zu}", i ? ", " : "",
            field->name, fl_type_name(field->type), field->width, field->offset);
    }
    ADD("]}\n");
#undef ADD
    return used;
}

static void put_uint32(uint8_t *at, uint32_t value)
{
    layout_put(FL_UINT32, 1, &value, false, at);
}

static void make_header(struct state *state)
{
    struct writer *writer = &state->writer;
    char *schema = writer->header + PREFIX;
    size_t size = writer->header_bytes - PREFIX;
    memcpy(writer->header, "FLOTREC1", 8);
    put_uint32((uint8_t *)writer->header + 8, (uint32_t)writer->header_bytes);
    put_uint32((uint8_t *)writer->header + 12, (uint32_t)state->record_bytes);
    size_t used = write_schema(state, fl_wall_less_monotonic_ns(), schema, size);
    memset(schema + used, ' ', size - used);
}

/* --- writer thread --- */

/* CRC-32 by half bytes: a table of 16 words stays in the cache of a small processor. */
static uint32_t crc32(const uint8_t *bytes, size_t count)
{
    static const uint32_t table[16] = {0x00000000, 0x1db71064, 0x3b6e20c8, 0x26d930ac, 0x76dc4190, 0x6b6b51f4,
                                       0x4db26158, 0x5005713c, 0xedb88320, 0xf00f9344, 0xd6d6a3e8, 0xcb61b38c,
                                       0x9b64c2b0, 0x86d3d2d4, 0xa00ae278, 0xbdbdf21c};
    uint32_t crc = UINT32_MAX;
    while (count--) {
        crc = (crc >> 4) ^ table[(crc ^ *bytes) & 15];
        crc = (crc >> 4) ^ table[(crc ^ (uint32_t)(*bytes++ >> 4)) & 15];
    }
    return ~crc;
}

static void close_file(struct writer *writer)
{
    if (writer->fd < 0)
        return;
    fdatasync(writer->fd);
    close(writer->fd);
    writer->fd = -1;
}

/* Stop for good: a disk that is full now and then would leave unexpected gaps. */
static void give_up(struct state *state, const char *what)
{
    const struct recorder *recorder = state->block->parameters;
    fl_warn(state->block, "recording to %s stops: %s: %s", recorder->directory, what, strerror(errno));
    atomic_store(&state->recording, false);
    close_file(&state->writer);
}

/* Write the bytes; returns how many were written. */
static size_t write_all(int fd, const void *bytes, size_t count)
{
    size_t done = 0;
    while (done < count) {
        ssize_t written = write(fd, (const char *)bytes + done, count - done);
        if (written > 0)
            done += (size_t)written;
        else if (written == 0 || errno != EINTR)
            break;
    }
    return done;
}

static bool open_next(struct state *state)
{
    struct writer *writer = &state->writer;
    const struct recorder *recorder = state->block->parameters;
    char name[FILE_BYTES];
    close_file(writer);
    do { /* another recorder may have taken the number */
        name_file(state, writer->next++, name);
        writer->fd = openat(state->directory, name, O_WRONLY | O_CREAT | O_EXCL | O_APPEND | O_CLOEXEC, 0644);
    } while (writer->fd < 0 && errno == EEXIST);
    if (writer->fd < 0) {
        give_up(state, name);
        return false;
    }
    know_file(state, writer->next - 1, recorder->files); /* makes room before anything is written */
    make_header(state);
    writer->written = (int64_t)write_all(writer->fd, writer->header, writer->header_bytes);
    if (writer->written < (int64_t)writer->header_bytes) {
        give_up(state, name);
        unlinkat(state->directory, name, 0);
        writer->file_count--;
        return false;
    }
    return true;
}

/* Records that still fit into the file; an empty file takes one of any size. */
static uint32_t room(const struct state *state)
{
    const struct recorder *recorder = state->block->parameters;
    const struct writer *writer = &state->writer;
    if (writer->fd < 0)
        return 0;
    int64_t fit = (recorder->file_bytes - writer->written) / (int64_t)state->record_bytes;
    if (fit < 1)
        return writer->written == (int64_t)writer->header_bytes;
    return fit < writer->batch_records ? (uint32_t)fit : writer->batch_records;
}

/* Write what has been taken, by whole records. */
static void write_batch(struct state *state, uint32_t count)
{
    struct writer *writer = &state->writer;
    size_t bytes = state->record_bytes;
    for (uint32_t i = 0; i < count; i++) {
        uint8_t *record = writer->batch + i * bytes;
        put_uint32(record + bytes - CHECK_BYTES, crc32(record, bytes - CHECK_BYTES));
    }
    uint32_t whole = (uint32_t)(write_all(writer->fd, writer->batch, count * bytes) / bytes);
    int error = errno;
    writer->written += (int64_t)(whole * bytes);
    writer->unsynced = true;
    atomic_fetch_add(&state->recorded, whole);
    if (whole == count)
        return;
    atomic_fetch_add(&state->unwritten, count - whole);
    if (ftruncate(writer->fd, (off_t)writer->written) < 0)
        fl_warn(state->block, "half a record stays at the end: %s", strerror(errno));
    errno = error;
    give_up(state, "write");
}

static void write_records(struct state *state)
{
    struct writer *writer = &state->writer;
    for (;;) {
        bool recording = atomic_load(&state->recording);
        uint32_t count = 0, most = recording ? room(state) : writer->batch_records;
        if (recording && most == 0) {
            open_next(state);
            continue;
        }
        while (count < most && fl_ring_take(&state->ring, writer->batch + count * state->record_bytes))
            count++;
        if (count == 0)
            return;
        if (recording)
            write_batch(state, count);
        else
            atomic_fetch_add(&state->unwritten, count);
    }
}

static void sync_records(struct state *state)
{
    const struct recorder *recorder = state->block->parameters;
    struct writer *writer = &state->writer;
    int64_t now_ns = fl_now_ns();
    if (writer->fd < 0 || !writer->unsynced || !(recorder->sync > 0) ||
        (double)(now_ns - writer->synced_ns) < 1e9 * recorder->sync)
        return;
    fdatasync(writer->fd);
    writer->synced_ns = now_ns;
    writer->unsynced = false;
}

static void run(struct fl_driver *driver, void *context)
{
    struct state *state = context;
    int stop;
    do {
        stop = fl_driver_wait(driver, -1, false, WAKE_MS);
        write_records(state);
        sync_records(state);
    } while (stop != -1);
    close_file(&state->writer);
}

/* --- block --- */

static int start(struct fl_block *block)
{
    const struct recorder *recorder = block->parameters;
    struct state *state = block->state;
    struct writer *writer = &state->writer;
    state->directory = writer->fd = -1;
    state->block = block;
    state->name = file_name(block);
    if (make_layout(block, &state->layout) != FL_OK)
        return FL_FAILED;
    state->record_bytes = state->layout.bytes + CHECK_BYTES;
    writer->next = 1;
    writer->batch_records = (uint32_t)(BATCH_BYTES / state->record_bytes) + 1;
    char none[1];
    /* No wall clock is further from the monotonic one than the longest number: the schema's length is bounded. */
    writer->header_bytes = (PREFIX + write_schema(state, INT64_MIN, none, 0) + 1 + 63) / 64 * 64;
    uint32_t buffered = buffered_records(block);
    void *memory = fl_allocate(block, fl_ring_bytes(state->record_bytes, buffered));
    writer->numbers = fl_allocate(block, (MOST_FILES + 1) * sizeof *writer->numbers);
    writer->batch = fl_allocate(block, writer->batch_records * state->record_bytes);
    writer->header = fl_allocate(block, writer->header_bytes);
    state->record = fl_allocate(block, state->record_bytes);
    if (!memory || !writer->numbers || !writer->batch || !writer->header || !state->record)
        return FL_FAILED;
    fl_ring_initialize(&state->ring, memory, state->record_bytes, buffered);
    state->directory = open(recorder->directory, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (state->directory < 0)
        return fl_fail(block, "cannot open directory %s: %s", recorder->directory, strerror(errno));
    if (find_files(block, state) != FL_OK)
        return FL_FAILED;
    atomic_store(&state->recording, true);
    /* A write or a sync keeps the kernel busy for milliseconds, which must not delay the robot. */
    state->driver = fl_driver_start_ordinary(block, run, state);
    return state->driver ? FL_OK : FL_FAILED;
}

static int step(struct fl_block *block)
{
    struct state *state = block->state;
    uint32_t lost = atomic_load_explicit(&state->ring.lost, memory_order_relaxed);
    layout_put(FL_INT64, 1, &block->release_ns, false, state->record + TIME_AT);
    layout_put(FL_UINT64, 1, &block->step, false, state->record + STEP_AT);
    put_uint32(state->record + LOST_AT, lost);
    for (uint32_t i = 0; i < state->layout.count; i++) {
        const struct layout_field *field = &state->layout.fields[i];
        layout_put(field->type, field->width, block->in[i], false, state->record + field->offset);
    }
    lost += !fl_ring_put(&state->ring, state->record);
    FL_OUT(block, RECORDING, bool) = atomic_load(&state->recording);
    FL_OUT(block, RECORDED, uint32_t) = atomic_load(&state->recorded);
    FL_OUT(block, LOST, uint32_t) = lost + atomic_load(&state->unwritten);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    fl_driver_stop(state->driver);
    state->driver = NULL;
    if (state->block && state->directory >= 0)
        close(state->directory);
    state->directory = -1;
}

FL_BLOCK(recorder) = {
    .abi = FL_ABI,
    .name = "recorder",
    .summary = "records signals to files: an input in0, in1, ... (or named) for each of types, every step",
    .source = "this project's own format, described in recorder.c; check: CRC-32 of IEEE 802.3",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct recorder),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .terminate = terminate,
};
