#include "status.h"

#include "inner.h"

#include <flotilla/sensor.h>
#include <inttypes.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>

enum { FIRST_PERIODS = 3 }; /* to a task's first step, at most */

struct sensor {
    const char *name;
    const bool *flag; /* the block's outputs */
    const double *age;
    _Atomic bool put_flag;
    _Atomic float put_age; /* every processor writes four bytes atomically */
};

/* An output with FL_REFUSALS. */
struct refusals {
    const char *block, *output;
    const uint32_t *count;
    _Atomic uint32_t put_count;
};

/* A sequence lock: `turn` is odd while the control thread writes. All of its writes have release order, so a reader
 * that sees any of them also sees that `turn`. */
struct status {
    _Alignas(64) _Atomic uint32_t turn;
    _Atomic int64_t ended_ns;
    _Atomic uint64_t steps, overruns, skipped, timeouts, overrun_step;
    _Atomic int64_t overrun_ns, late_ns;
    const struct task *task;
    int64_t begun_ns;
    struct refusals *refusals; /* those of a block side by side */
    size_t refusals_count;
    size_t count;
    struct sensor sensors[];
};

struct reading {
    uint64_t steps, overruns, skipped, timeouts, overrun_step;
    int64_t overrun_ns, late_ns;
    uint32_t *refusals;
    struct {
        bool flag;
        float age;
    } sensors[];
};

#define PUT(member, value) atomic_store_explicit(&(member), (value), memory_order_release)
#define GET(member)        atomic_load_explicit(&(member), memory_order_acquire)

/* Index of the first of the three outputs; -1: the block is not a sensor. */
static int sensor_port(const struct fl_block *block)
{
    static const struct fl_port wanted[] = {FL_SENSOR_OUTPUTS};
    enum { WANTED = sizeof wanted / sizeof *wanted };
    for (uint32_t first = 0; first + WANTED <= block->out_count; first++) {
        const struct fl_port *there = &block->out_ports[first];
        uint32_t same = 0;
        while (same < WANTED && strcmp(there[same].name, wanted[same].name) == 0 &&
               there[same].type == wanted[same].type && there[same].width == wanted[same].width)
            same++;
        if (same == WANTED)
            return (int)first;
    }
    return -1;
}

static void find_refusals(struct status *status, const struct task *task)
{
    size_t most = 0;
    for (size_t i = 0; i < task->count; i++)
        most += task->blocks[i].block->out_count;
    status->refusals = calloc(most + 1, sizeof *status->refusals);
    if (!status->refusals)
        abort();
    for (size_t i = 0; i < task->count; i++) {
        const struct fl_block *block = task->blocks[i].block;
        for (uint32_t port = 0; port < block->out_count; port++)
            if (block->out_ports[port].flags & FL_REFUSALS)
                status->refusals[status->refusals_count++] = (struct refusals){
                    .block = block->name, .output = block->out_ports[port].name, .count = block->out[port]};
    }
}

struct status *status_create(const struct task *task)
{
    size_t bytes = sizeof(struct status) + task->count * sizeof(struct sensor);
    struct status *status = aligned_alloc(64, (bytes + 63) / 64 * 64);
    if (!status)
        abort();
    memset(status, 0, bytes);
    status->task = task;
    status->begun_ns = fl_now_ns();
    atomic_init(&status->ended_ns, status->begun_ns + FIRST_PERIODS * task->period_ns);
    find_refusals(status, task);
    for (size_t i = 0; i < task->count; i++) {
        const struct fl_block *block = task->blocks[i].block;
        int port = sensor_port(block);
        if (port >= 0)
            status->sensors[status->count++] =
                (struct sensor){.name = block->name, .flag = block->out[port], .age = block->out[port + 1]};
    }
    return status;
}

void status_destroy(struct status *status)
{
    if (status)
        free(status->refusals);
    free(status);
}

void status_put(struct status *status, const struct run_result *result, int64_t now_ns)
{
    uint32_t turn = atomic_load_explicit(&status->turn, memory_order_relaxed);
    atomic_store_explicit(&status->turn, turn + 1, memory_order_relaxed);
    PUT(status->ended_ns, now_ns);
    PUT(status->steps, result->steps);
    PUT(status->timeouts, result->timeouts);
    if (result->overruns != atomic_load_explicit(&status->overruns, memory_order_relaxed)) {
        PUT(status->overruns, result->overruns);
        PUT(status->skipped, result->skipped);
        PUT(status->overrun_step, result->last_overrun.step);
        PUT(status->overrun_ns, result->last_overrun.at_ns);
        PUT(status->late_ns, result->last_overrun.late_ns);
    }
    for (struct sensor *sensor = status->sensors, *end = sensor + status->count; sensor < end; sensor++) {
        PUT(sensor->put_flag, *sensor->flag);
        PUT(sensor->put_age, (float)*sensor->age);
    }
    for (struct refusals *each = status->refusals, *end = each + status->refusals_count; each < end; each++)
        PUT(each->put_count, *each->count);
    PUT(status->turn, turn + 2);
}

uint64_t status_steps(const struct status *status)
{
    return GET(status->steps);
}

int64_t status_ended_ns(const struct status *status)
{
    return GET(status->ended_ns);
}

/* Copy the state; to be freed, after its `refusals`. Repeats while the control thread writes, which takes well under a
 * microsecond of each period. */
static struct reading *read_status(const struct status *status)
{
    struct reading *reading = calloc(1, sizeof *reading + status->count * sizeof reading->sensors[0]);
    if (!reading || !(reading->refusals = calloc(status->refusals_count + 1, sizeof *reading->refusals)))
        abort();
    for (;; sched_yield()) {
        uint32_t turn = GET(status->turn);
        reading->steps = GET(status->steps);
        reading->overruns = GET(status->overruns);
        reading->skipped = GET(status->skipped);
        reading->timeouts = GET(status->timeouts);
        reading->overrun_step = GET(status->overrun_step);
        reading->overrun_ns = GET(status->overrun_ns);
        reading->late_ns = GET(status->late_ns);
        for (size_t i = 0; i < status->count; i++) {
            reading->sensors[i].flag = GET(status->sensors[i].put_flag);
            reading->sensors[i].age = GET(status->sensors[i].put_age);
        }
        for (size_t i = 0; i < status->refusals_count; i++)
            reading->refusals[i] = GET(status->refusals[i].put_count);
        if (turn % 2 == 0 && turn == atomic_load_explicit(&status->turn, memory_order_relaxed))
            return reading;
    }
}

static double seconds(int64_t ns)
{
    return (double)ns / 1e9;
}

/* The actuators that wait for a command that is off. */
static void write_waiting(const struct status *status, bool json, FILE *out)
{
    bool any = false;
    for (size_t i = 0; i < status->task->count; i++) {
        const struct fl_block *block = status->task->blocks[i].block;
        if (!inner_waits(block))
            continue;
        fprintf(out, json ? "%s\"%s\"" : "%s%s",
                any    ? ", "
                : json ? ""
                       : "waiting for a command that is off: ",
                block->name);
        any = true;
    }
    if (any && !json)
        fputc('\n', out);
}

/* The blocks whose serial ports have lost bytes. */
static void write_lost(const struct status *status, bool json, FILE *out)
{
    bool any = false;
    for (size_t i = 0; i < status->task->count; i++) {
        const struct fl_block *block = status->task->blocks[i].block;
        const uint32_t lost = inner_lost(block);
        if (!lost)
            continue;
        fprintf(out, json ? "%s\"%s\": %" PRIu32 : "%sserial overruns of %s: %" PRIu32 "\n", json && any ? ", " : "",
                block->name, lost);
        any = true;
    }
}

/* The counts that are not 0, those of a block together; what stands around names depends on `json`. */
static void write_refusals(const struct status *status, const struct reading *reading, bool json, FILE *out)
{
    const char *block = NULL; /* the one before */
    for (size_t i = 0; i < status->refusals_count; i++) {
        const struct refusals *each = &status->refusals[i];
        if (!reading->refusals[i])
            continue;
        if (each->block == block)
            fputs(", ", out);
        else if (json)
            fprintf(out, "%s\"%s\": {", block ? "}, " : "", each->block);
        else
            fprintf(out, "%srefused by %s: ", block ? "\n" : "", each->block);
        if (json)
            fprintf(out, "\"%s\": %" PRIu32, each->output, reading->refusals[i]);
        else
            fprintf(out, "%" PRIu32 " %s", reading->refusals[i], each->output);
        block = each->block;
    }
    if (block)
        fputs(json ? "}" : "\n", out);
}

static void write_json(const struct status *status, const struct reading *reading, int64_t now_ns, FILE *out)
{
    fprintf(out, "{\"task\": \"%s\", \"period_s\": %g, \"running_s\": %.3f, \"steps\": %" PRIu64, status->task->name,
            seconds(status->task->period_ns), seconds(now_ns - status->begun_ns), reading->steps);
    fprintf(out, ", \"overruns\": %" PRIu64 ", \"skipped\": %" PRIu64 ", \"timeouts\": %" PRIu64 ", \"last_overrun\": ",
            reading->overruns, reading->skipped, reading->timeouts);
    if (reading->overruns)
        fprintf(out, "{\"step\": %" PRIu64 ", \"ago_s\": %.3f, \"late_s\": %.9f}", reading->overrun_step,
                seconds(now_ns - reading->overrun_ns), seconds(reading->late_ns));
    else
        fputs("null", out);
    fputs(", \"sensors\": {", out);
    for (size_t i = 0; i < status->count; i++)
        fprintf(out, "%s\"%s\": {\"flag\": %s, \"age_s\": %.6f}", i ? ", " : "", status->sensors[i].name,
                reading->sensors[i].flag ? "true" : "false", (double)reading->sensors[i].age);
    fputs("}, \"refused\": {", out);
    write_refusals(status, reading, true, out);
    fputs("}, \"serial_overruns\": {", out);
    write_lost(status, true, out);
    fputs("}, \"waiting\": [", out);
    write_waiting(status, true, out);
    fputs("]}\n", out);
}

static void write_text(const struct status *status, const struct reading *reading, int64_t now_ns, FILE *out)
{
    fprintf(out, "period: %g s\nrunning: %.3f s\nsteps: %" PRIu64 "\n", seconds(status->task->period_ns),
            seconds(now_ns - status->begun_ns), reading->steps);
    fprintf(out, "overruns: %" PRIu64 ", %" PRIu64 " releases skipped", reading->overruns, reading->skipped);
    if (reading->overruns)
        fprintf(out, "; the last %.3f s ago: step %" PRIu64 " ended %.6f s late", seconds(now_ns - reading->overrun_ns),
                reading->overrun_step, seconds(reading->late_ns));
    fprintf(out, "\ntimeouts: %" PRIu64 "\n", reading->timeouts);
    for (size_t i = 0; i < status->count; i++)
        fprintf(out, "%s: flag %d, age %.3f s\n", status->sensors[i].name, reading->sensors[i].flag,
                (double)reading->sensors[i].age);
    write_waiting(status, false, out);
    write_refusals(status, reading, false, out);
    write_lost(status, false, out);
}

void status_write(const struct status *status, bool json, FILE *out)
{
    struct reading *reading = read_status(status);
    (json ? write_json : write_text)(status, reading, fl_now_ns(), out);
    free(reading->refusals);
    free(reading);
}
