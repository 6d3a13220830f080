#define _GNU_SOURCE
#include "testbed.h"

#include "executive/block.h"
#include "executive/parameter.h"
#include "executive/registry.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { SETTINGS = 32, ELEMENTS = 64, PERIOD_NS = 10 * 1000 * 1000 };

static char said[4096];

static struct raw_value setting(const char *name, const char *value)
{
    char *copy = strdup(value), *rest = copy;
    struct raw_value raw = {.name = name, .line = 1, .list = strchr(value, ',') != NULL};
    raw.text = calloc(ELEMENTS, sizeof(char *));
    for (char *element; (element = strsep(&rest, ",")) && raw.count < ELEMENTS;)
        raw.text[raw.count++] = strdup(element);
    free(copy);
    return raw;
}

static void forget(struct raw_value *raw)
{
    for (size_t i = 0; i < raw->count; i++)
        free((char *)(uintptr_t)raw->text[i]);
    free(raw->text);
}

static struct fl_block *make(const char *type, va_list arguments)
{
    struct registry registry = {0};
    struct raw_value settings[SETTINGS];
    size_t count = 0;
    FILE *out = fmemopen(said, sizeof said, "w");
    struct problems problems = {.file = "task", .out = out};
    memset(said, 0, sizeof said);
    assert_int_equal(registry_fill(&registry, NULL, stderr), 0);
    const struct fl_block_type *found = registry_find(&registry, type);
    registry_clear(&registry);
    if (!found)
        fail_msg("there is no block %s", type);
    for (const char *name; (name = va_arg(arguments, const char *));)
        settings[count++] = setting(name, va_arg(arguments, const char *));
    struct fl_block *block = block_create(found, type);
    block->period_ns = PERIOD_NS;
    block->release_ns = fl_now_ns();
    parameters_set(block, settings, count, 1, &problems);
    for (size_t i = 0; i < count; i++)
        forget(&settings[i]);
    if (!problems.count && found->configure && found->configure(block) != FL_OK)
        problem(&problems, 1, "block %s: %s", type, block->service->failure);
    fclose(out);
    if (problems.count) {
        block_destroy(block);
        return NULL;
    }
    assert_int_equal(block_make_signals(block), FL_OK);
    return block;
}

struct fl_block *testbed_block(const char *type, ...)
{
    va_list arguments;
    va_start(arguments, type);
    struct fl_block *block = make(type, arguments);
    va_end(arguments);
    if (!block)
        fail_msg("%s", said);
    return block;
}

const char *testbed_refusal(const char *type, ...)
{
    va_list arguments;
    va_start(arguments, type);
    struct fl_block *block = make(type, arguments);
    va_end(arguments);
    if (block) {
        block_destroy(block);
        fail_msg("%s was accepted", type);
    }
    return said;
}

void testbed_begin(struct fl_block *block)
{
    if (block->type->start && block->type->start(block) != FL_OK)
        fail_msg("start: %s", block->service->failure);
    if (block->type->initialize && block->type->initialize(block) != FL_OK)
        fail_msg("initialize: %s", block->service->failure);
}

int testbed_step(struct fl_block *block)
{
    return testbed_step_after(block, block->period_ns);
}

int testbed_step_after(struct fl_block *block, int64_t interval_ns)
{
    block_release(block, block->release_ns + interval_ns);
    int result = block->type->step(block);
    block->step++;
    return result;
}

static uint32_t port_named(const struct fl_port *ports, uint32_t count, const char *name)
{
    for (uint32_t i = 0; i < count; i++)
        if (strcmp(ports[i].name, name) == 0)
            return i;
    fail_msg("there is no port %s", name);
    return 0;
}

void *testbed_input(struct fl_block *block, const char *port)
{
    return (void *)(uintptr_t)block->in[port_named(block->in_ports, block->in_count, port)];
}

void testbed_wire(struct fl_block *block, const char *port)
{
    block_wire(block, port_named(block->in_ports, block->in_count, port), testbed_input(block, port));
}

const void *testbed_output(struct fl_block *block, const char *port)
{
    return block->out[port_named(block->out_ports, block->out_count, port)];
}

void testbed_near(double value, double expected, double tolerance, const char *file, int line)
{
    if (!(fabs(value - expected) <= tolerance)) {
        print_error("%.17g is not within %g of %.17g\n", value, tolerance, expected);
        _fail(file, line);
    }
}

void testbed_end(struct fl_block *block)
{
    if (block->type->terminate)
        block->type->terminate(block);
    block_destroy(block);
}
