#define _GNU_SOURCE
#include "inner.h"

#include "block.h"
#include "device.h"
#include "parameter.h"
#include "registry.h"

#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { PORTS_BYTES = 1024, TUNABLES = 64 };

struct fl_inner {
    struct fl_inner *next; /* of the same outer block */
    struct fl_block *outer, *block;
    struct raw_value *raw; /* parameters, until it starts */
    size_t raw_count;
    const char *tunable[TUNABLES];
    const struct fl_parameter *tuned[TUNABLES];
    size_t tunable_count;
    bool started; /* terminate is due */
};

/* Blocks start one after the other, in one thread. */
static struct fl_block *beginning;

void fl_inner_begin(struct fl_block *outer)
{
    beginning = outer;
}

int fl_inner_result(const struct fl_block *outer)
{
    return outer->service->inner_failed ? FL_FAILED : FL_OK;
}

uint32_t inner_lost(const struct fl_block *outer)
{
    uint32_t lost = atomic_load_explicit(&outer->service->lost, memory_order_relaxed);
    for (const struct fl_inner *inner = outer->service->inner; inner; inner = inner->next)
        lost += inner->block ? inner_lost(inner->block) : 0;
    return lost;
}

bool inner_waits(const struct fl_block *outer)
{
    bool waits = atomic_load_explicit(&outer->service->wait, memory_order_relaxed) == FL_WAITS;
    for (const struct fl_inner *inner = outer->service->inner; inner && !waits; inner = inner->next)
        waits = inner->block && inner_waits(inner->block);
    return waits;
}

void fl_inner_safe(const struct fl_block *outer)
{
    for (const struct fl_inner *inner = outer->service->inner; inner; inner = inner->next)
        if (inner->started && inner->block->type->safe) {
            inner->block->type->safe(inner->block);
            const char *reason = atomic_load(&inner->block->service->not_safe);
            if (reason)
                fl_not_safe(inner->outer, reason);
        }
}

/* Keep the first failure only. */
static void fail(const struct fl_inner *inner, const char *type, const char *reason)
{
    if (inner->outer->service->inner_failed)
        return;
    inner->outer->service->inner_failed = true;
    fl_fail(inner->outer, "inner %s: %s", type, reason);
}

static void destroy(const struct fl_block *outer)
{
    for (const struct fl_inner *inner = outer->service->inner; inner; inner = inner->next) {
        free(inner->raw);
        block_destroy(inner->block);
    }
}

struct fl_inner *fl_inner_new(const char *type, double period_s)
{
    if (!beginning)
        return NULL;
    struct fl_service *service = beginning->service;
    struct fl_inner *inner = fl_allocate(beginning, sizeof *inner);
    if (!inner) {
        service->inner_failed = true;
        return NULL;
    }
    inner->outer = beginning;
    const struct fl_block_type *found = service->registry ? registry_find(service->registry, type) : NULL;
    if (!found) {
        fail(inner, type, "there is no such block; flotilla-blocks lists them");
        return inner;
    }
    int64_t period_ns = llround(fmin(period_s, 1e9) * 1e9);
    if (!(period_s >= 0) || (period_ns && period_ns % beginning->period_ns)) {
        char reason[128];
        snprintf(reason, sizeof reason, "its period of %g s is not a multiple of the block's, %g s", period_s,
                 (double)beginning->period_ns / 1e9);
        fail(inner, type, reason);
        return inner;
    }
    inner->block = block_create(found, beginning->name);
    inner->block->period_ns = period_ns ? period_ns : beginning->period_ns;
    inner->block->service->priority = service->priority;
    inner->block->service->patience_ms = service->patience_ms;
    inner->block->service->wait = service->wait;
    inner->next = service->inner;
    service->inner = inner;
    service->destroy_inner = destroy;
    return inner;
}

/* Append a value with room for `count` strings; NULL after a failure. */
static struct raw_value *more(struct fl_inner *inner, const char *parameter, bool list, size_t count)
{
    if (!inner || !inner->block)
        return NULL;
    struct raw_value *raw = realloc(inner->raw, sizeof *raw * (inner->raw_count + 1));
    const char **text = fl_allocate(inner->block, sizeof *text * (count + 1));
    if (!raw || !text)
        abort(); /* as block_create does: nothing runs yet */
    inner->raw = raw;
    raw += inner->raw_count++;
    *raw = (struct raw_value){.name = parameter, .line = 0, .list = list, .text = text};
    return raw;
}

static void add_text(const struct fl_inner *inner, struct raw_value *raw, const char *text, size_t length)
{
    char *copy = fl_allocate(inner->block, length + 1);
    if (!copy)
        abort();
    memcpy(copy, text, length);
    raw->text[raw->count++] = copy;
}

void fl_inner_parameter(struct fl_inner *inner, const char *parameter, const void *text, size_t length)
{
    const char *at = text, *end = at + length;
    bool list = length >= 2 && at[0] == '[' && end[-1] == ']';
    struct raw_value *raw = more(inner, parameter, list, length);
    if (!raw)
        return;
    if (!list) {
        add_text(inner, raw, at, length);
        return;
    }
    for (at++, end--; at < end;) {
        const char *next = memchr(at, ',', (size_t)(end - at)), *last = next ? next : end;
        while (at < last && *at == ' ')
            at++;
        while (last > at && last[-1] == ' ')
            last--;
        add_text(inner, raw, at, (size_t)(last - at));
        at = next ? next + 1 : end;
    }
}

/* NULL where there is none, which fl_inner_start reports. */
static const struct fl_parameter *parameter_of(const struct fl_inner *inner, const char *name)
{
    char reason[256];
    return parameter_find(inner->block->type, name, reason, sizeof reason);
}

void fl_inner_numbers(struct fl_inner *inner, const char *parameter, const double *values, size_t count)
{
    struct raw_value *raw = more(inner, parameter, count != 1, count);
    if (!raw)
        return;
    const struct fl_parameter *found = parameter_of(inner, parameter);
    enum fl_kind kind = found ? found->kind : FL_KIND_DOUBLE;
    for (size_t i = 0; i < count; i++) {
        char text[32];
        snprintf(text, sizeof text, "%.17g", values[i]);
        if (kind == FL_KIND_BOOLEAN && (strcmp(text, "0") == 0 || strcmp(text, "1") == 0))
            snprintf(text, sizeof text, *text == '1' ? "true" : "false");
        add_text(inner, raw, text, strlen(text));
    }
}

void fl_inner_tunable(struct fl_inner *inner, const char *parameter, double value)
{
    fl_inner_numbers(inner, parameter, &value, 1);
    if (inner && inner->tunable_count < TUNABLES)
        inner->tunable[inner->tunable_count++] = parameter;
}

/* Set all parameters; problems go into one message, without its last newline. */
static bool set_parameters(struct fl_inner *inner)
{
    char *said = NULL;
    size_t size = 0;
    struct problems problems = {.file = "parameters", .out = open_memstream(&said, &size)};
    if (!problems.out)
        abort();
    parameters_set(inner->block, inner->raw, inner->raw_count, 0, &problems);
    fclose(problems.out);
    if (problems.count) {
        said[size - 1] = '\0';
        fail(inner, inner->block->type->name, said);
    }
    free(said);
    free(inner->raw);
    inner->raw = NULL;
    for (size_t i = 0; i < inner->tunable_count; i++)
        inner->tuned[i] = parameter_of(inner, inner->tunable[i]);
    return !problems.count;
}

void fl_inner_ports(const struct fl_block *block, char *ports, size_t size)
{
    size_t used = 0;
    for (uint32_t i = 0; i <= block->in_count + block->out_count && used < size; i++) {
        bool output = i > block->in_count;
        const struct fl_port *port = output ? &block->out_ports[i - block->in_count - 1] : &block->in_ports[i];
        if (i == block->in_count)
            used += (size_t)snprintf(ports + used, size - used, ">");
        else
            used += (size_t)snprintf(ports + used, size - used, "%s%s[%u]%s", output ? " " : "",
                                     fl_type_name(port->type), (unsigned)port->width, output ? "" : " ");
    }
}

struct fl_block *inner_configure(struct fl_inner *inner)
{
    struct fl_block *block = inner ? inner->block : NULL;
    if (!block || !set_parameters(inner))
        return NULL;
    const struct fl_block_type *type = block->type;
    if ((!type->configure || type->configure(block) == FL_OK) && block_make_signals(block) == FL_OK)
        return block;
    fail(inner, type->name, block->service->failure);
    return NULL;
}

void fl_inner_start(struct fl_inner *inner, const char *ports)
{
    char found[PORTS_BYTES], reason[2 * PORTS_BYTES + 128];
    struct fl_block *block = inner_configure(inner);
    if (!block)
        return;
    const struct fl_block_type *type = block->type;
    fl_inner_ports(block, found, sizeof found);
    if (strcmp(found, ports) != 0) {
        snprintf(reason, sizeof reason,
                 "its ports are %s, and the code was made for %s; generate it again with flotilla-blocks --legacy-code",
                 found, ports);
        fail(inner, type->name, reason);
        return;
    }
    if (device_claim(block) != FL_OK) {
        fail(inner, type->name, block->service->failure);
        return;
    }
    inner->started = true; /* terminate also cleans up after a start that failed halfway */
    if ((type->start && type->start(block) != FL_OK) || (type->initialize && type->initialize(block) != FL_OK))
        fail(inner, type->name, block->service->failure);
}

/* By the parameter's C type. */
static void put(const struct fl_parameter *parameter, void *place, double value)
{
    switch (parameter->kind) {
    case FL_KIND_BOOLEAN:
        *(bool *)place = value > 0;
        break;
    case FL_KIND_INTEGER:
        *(int64_t *)place = (int64_t)value;
        break;
    case FL_KIND_UNSIGNED:
        *(uint64_t *)place = (uint64_t)value;
        break;
    default:
        *(double *)place = value;
        break;
    }
}

static bool allowed(const struct fl_parameter *parameter, double value)
{
    if (!isfinite(value) || (parameter->kind == FL_KIND_BOOLEAN && (value < 0 || value > 1)))
        return false;
    if (parameter->kind != FL_KIND_DOUBLE && (fabs(value) > 0x1p53 || value - floor(value) > 0))
        return false;
    return !(parameter->min < parameter->max) || (value >= parameter->min && value <= parameter->max);
}

static bool runs(const struct fl_inner *inner)
{
    return inner && inner->started && !inner->outer->service->inner_failed;
}

void fl_inner_tune(struct fl_inner *inner, const double *values)
{
    if (!runs(inner))
        return;
    for (size_t i = 0; i < inner->tunable_count; i++) {
        const struct fl_parameter *parameter = inner->tuned[i];
        void *place = (char *)(uintptr_t)inner->block->parameters + parameter->offset;
        double present = parameter_number(parameter->kind, place);
        if (!(values[i] < present) && !(values[i] > present) && !isnan(values[i]))
            continue;
        if (allowed(parameter, values[i])) {
            put(parameter, place, values[i]);
            continue;
        }
        char reason[128];
        snprintf(reason, sizeof reason, "parameter %s: %g is not allowed", parameter->name, values[i]);
        fail(inner, inner->block->type->name, reason);
    }
}

void fl_inner_step(struct fl_inner *inner, const void *const *in, void *const *out)
{
    if (!runs(inner))
        return;
    struct fl_block *block = inner->block;
    for (uint32_t i = 0; i < block->in_count; i++)
        block_wire(block, i, in[i]);
    block_release(block, inner->outer->release_ns);
    if (block->type->step(block) != FL_OK)
        fail(inner, block->type->name, block->service->failure);
    block->step++;
    for (uint32_t i = 0; i < block->out_count; i++)
        memcpy(out[i], block->out[i], fl_type_size(block->out_ports[i].type) * block->out_ports[i].width);
}

void fl_inner_terminate(struct fl_inner *inner)
{
    if (!inner || !inner->started)
        return;
    inner->started = false;
    if (inner->block->type->terminate)
        inner->block->type->terminate(inner->block);
}

void fl_inner_end(const struct fl_block *outer)
{
    for (struct fl_inner *inner = outer->service->inner; inner; inner = inner->next)
        fl_inner_terminate(inner);
}

int64_t inner_shortest(const struct fl_block *outer, int64_t (*of)(const struct fl_block *block))
{
    int64_t shortest = INT64_MAX;
    for (const struct fl_inner *inner = outer->service->inner; inner; inner = inner->next) {
        int64_t value = inner->block ? of(inner->block) : INT64_MAX;
        shortest = value < shortest ? value : shortest;
    }
    return shortest;
}
