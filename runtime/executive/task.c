#define _GNU_SOURCE
#include "task.h"

#include "block.h"
#include "device.h"
#include "inner.h"

#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* An input's place in the graph, while it is built. */
struct edge {
    size_t from, to; /* `from` runs first */
    bool delayed;    /* of a delayed input `port` of `from`; where `to` has to run first, the input is latched */
    uint32_t port;
};

struct building {
    struct task *task;
    const struct task_file *file;
    struct problems *problems;
    struct edge *edges;
    size_t edge_count;
};

static void *grown(void *memory, size_t bytes)
{
    memory = realloc(memory, bytes);
    if (!memory)
        abort();
    return memory;
}

/* --- blocks --- */

static void make_block(struct building *building, struct registry *registry, const struct block_entry *entry)
{
    struct task_block *task_block = &building->task->blocks[building->task->count];
    const struct fl_block_type *type = entry->type ? registry_find(registry, entry->type) : NULL;
    if (!type) {
        const char *nearest = entry->type ? registry_nearest(registry, entry->type) : NULL;
        if (entry->type)
            problem(building->problems, entry->line, "block %s: there is no block %s%s%s; flotilla-blocks lists them",
                    entry->name, entry->type, nearest ? ", the nearest is " : "", nearest ? nearest : "");
        return;
    }
    struct fl_block *block = block_create(type, entry->name);
    unsigned before = building->problems->count;
    *task_block = (struct task_block){.block = block, .every = entry->every, .offset = entry->offset};
    building->task->count++;
    block->period_ns = building->file->period_ns * entry->every;
    block->service->priority = building->task->priority ? building->task->priority - 1 : 0;
    block->service->registry = registry;
    parameters_set(block, entry->parameters, entry->parameter_count, entry->line, building->problems);
    parameters_bound(block, entry->bounds, entry->bound_count, building->problems);
    if (building->problems->count == before && type->configure && type->configure(block) != FL_OK)
        problem(building->problems, entry->line, "block %s: %s", entry->name, block->service->failure);
    task_block->wrong = building->problems->count != before;
    task_block->incomplete = type->configure && building->problems->count != before;
    if (block_make_signals(block) != FL_OK)
        problem(building->problems, entry->line, "block %s: %s", entry->name, block->service->failure);
}

static const void *value_of(const struct fl_block *block, const struct fl_parameter *parameter)
{
    return (const char *)block->parameters + parameter->offset;
}

static const struct fl_device *device_of(const struct fl_block *block)
{
    for (uint32_t i = 0; i < block->type->parameter_count; i++)
        if (block->type->parameters[i].kind == FL_KIND_DEVICE)
            return value_of(block, &block->type->parameters[i]);
    return NULL;
}

/* The output of device_write(), to be freed; NULL: the block has no device. */
static char *device_text(const struct fl_block *block)
{
    char *text = NULL;
    size_t size = 0;
    FILE *out = open_memstream(&text, &size);
    if (!out)
        abort();
    bool any = device_write(block, out);
    if (fclose(out) == 0 && any)
        return text;
    free(text);
    return NULL;
}

static bool same_device(const struct fl_block *a, const char *of_a, const struct fl_block *b, const char *of_b)
{
    const struct fl_device *one = device_of(a), *other = device_of(b);
    if (one && other) /* blocks of any types */
        return one->path && other->path && strcmp(one->path, other->path) == 0;
    return a->type == b->type && of_a && of_b && strcmp(of_a, of_b) == 0;
}

/* Two blocks on one device would take each other's bytes, or undo each other's commands. */
static void check_devices(struct building *building)
{
    const struct task *task = building->task;
    char **devices = grown(NULL, sizeof *devices * (task->count + 1));
    for (size_t i = 0; i < task->count; i++) {
        const struct fl_block *later = task->blocks[i].block;
        devices[i] = task->blocks[i].wrong ? NULL : device_text(later);
        for (size_t j = 0; j < i; j++) {
            const struct fl_block *earlier = task->blocks[j].block;
            if (same_device(later, devices[i], earlier, devices[j]))
                problem(building->problems, building->file->blocks[i].line,
                        "block %s: %s is block %s's; only one block may use a device", later->name, devices[i],
                        earlier->name);
        }
    }
    for (size_t i = 0; i < task->count; i++)
        free(devices[i]);
    free(devices);
}

/* --- wires --- */

static struct fl_block *block_named(const struct task *task, const char *name, size_t length, size_t *index)
{
    for (size_t i = 0; i < task->count; i++) {
        struct fl_block *block = task->blocks[i].block;
        if (strlen(block->name) == length && memcmp(block->name, name, length) == 0) {
            if (index)
                *index = i;
            return block;
        }
    }
    return NULL;
}

static void list_ports(const struct fl_port *ports, uint32_t count, char *out, size_t size)
{
    size_t used = 0;
    snprintf(out, size, "none");
    for (uint32_t i = 0; i < count && used < size; i++)
        used += (size_t)snprintf(out + used, size - used, "%s%s", i ? ", " : "", ports[i].name);
}

static int port_named(const struct fl_port *ports, uint32_t count, const char *name, size_t length)
{
    for (uint32_t i = 0; i < count; i++)
        if (strlen(ports[i].name) == length && memcmp(ports[i].name, name, length) == 0)
            return (int)i;
    return -1;
}

/* What "block.port[index]" means; NULL with a reason. */
static const void *find_signal(const struct task *task, const char *name, size_t *source, enum fl_type *type,
                               uint32_t *width, char *reason, size_t reason_size)
{
    char known[160];
    size_t block_length = strcspn(name, ".");
    const char *port_name = name + block_length + (name[block_length] == '.');
    size_t port_length = strcspn(port_name, "[");
    const struct fl_block *block = block_named(task, name, block_length, source);
    if (!name[block_length] || !port_length) {
        snprintf(reason, reason_size, "%s is neither a wire (block.port) nor a number", name);
        return NULL;
    }
    if (!block) {
        snprintf(reason, reason_size, "%s: the task has no block %.*s", name, (int)block_length, name);
        return NULL;
    }
    int port = port_named(block->out_ports, block->out_count, port_name, port_length);
    if (port < 0) {
        list_ports(block->out_ports, block->out_count, known, sizeof known);
        snprintf(reason, reason_size, "%s: %s has no output %.*s; it has %s", name, block->type->name, (int)port_length,
                 port_name, known);
        return NULL;
    }
    *type = block->out_ports[port].type;
    *width = block->out_ports[port].width;
    if (!port_name[port_length])
        return block->out[port];
    char *end;
    unsigned long element = strtoul(port_name + port_length + 1, &end, 10);
    if (strcmp(end, "]") != 0 || end == port_name + port_length + 1 || element >= *width) {
        snprintf(reason, reason_size, "%s: its elements are [0] to [%u]", name, (unsigned)(*width - 1));
        return NULL;
    }
    *width = 1;
    return (const char *)block->out[port] + element * fl_type_size(*type);
}

const void *task_signal(const struct task *task, const char *name, enum fl_type *type, uint32_t *width, char *reason,
                        size_t reason_size)
{
    return find_signal(task, name, NULL, type, width, reason, reason_size);
}

#define PUT_INTEGER(c_type, low, high)                                                                                 \
    if (!read_integer(text, &integer) || integer < (low) || integer > (int64_t)(high))                                 \
        return false;                                                                                                  \
    *(c_type *)place = (c_type)integer;                                                                                \
    return true

/* Store a constant in a signal; false where the type has no such value. */
static bool put_constant(const char *text, enum fl_type type, void *place)
{
    int64_t integer;
    uint64_t count;
    double real;
    switch (type) {
    case FL_BOOLEAN:
        *(uint8_t *)place = strcmp(text, "true") == 0 || strcmp(text, "1") == 0;
        return *(uint8_t *)place || strcmp(text, "false") == 0 || strcmp(text, "0") == 0;
    case FL_INT8:
        PUT_INTEGER(int8_t, INT8_MIN, INT8_MAX);
    case FL_UINT8:
        PUT_INTEGER(uint8_t, 0, UINT8_MAX);
    case FL_INT16:
        PUT_INTEGER(int16_t, INT16_MIN, INT16_MAX);
    case FL_UINT16:
        PUT_INTEGER(uint16_t, 0, UINT16_MAX);
    case FL_INT32:
        PUT_INTEGER(int32_t, INT32_MIN, INT32_MAX);
    case FL_UINT32:
        PUT_INTEGER(uint32_t, 0, UINT32_MAX);
    case FL_INT64:
        PUT_INTEGER(int64_t, INT64_MIN, INT64_MAX);
    case FL_UINT64:
        if (!read_unsigned(text, &count))
            return false;
        *(uint64_t *)place = count;
        return true;
    case FL_SINGLE:
        if (!read_double(text, &real))
            return false;
        *(float *)place = (float)real;
        return true;
    case FL_DOUBLE:
        return read_double(text, place);
    case FL_TYPES:
        break;
    }
    return false;
}

/* Whether a string is a constant: a number, true or false. No name of a block looks like these. */
static bool is_constant(const char *text)
{
    return strchr("0123456789+-.", *text) || strcmp(text, "true") == 0 || strcmp(text, "false") == 0;
}

static void wire_constants(struct building *building, struct fl_block *block, uint32_t port,
                           const struct raw_value *raw)
{
    const struct fl_port *to = &block->in_ports[port];
    size_t size = fl_type_size(to->type);
    char *place = (char *)(uintptr_t)block->in[port];
    block_wire(block, port, place); /* to itself */
    if (raw->count != to->width) {
        problem(building->problems, raw->line, "block %s: input %s has %u elements, not %zu", block->name, to->name,
                (unsigned)to->width, raw->count);
        return;
    }
    for (size_t i = 0; i < raw->count; i++)
        if (!put_constant(raw->text[i], to->type, place + i * size))
            problem(building->problems, raw->line, "block %s: input %s: %s is not a %s", block->name, to->name,
                    raw->text[i], fl_type_name(to->type));
}

static void wire_input(struct building *building, size_t index, uint32_t port, const struct raw_value *raw)
{
    char reason[256];
    enum fl_type type;
    uint32_t width;
    size_t source = index;
    struct fl_block *block = building->task->blocks[index].block;
    const struct fl_port *to = &block->in_ports[port];
    if (raw->list || !raw->count || is_constant(raw->text[0])) {
        wire_constants(building, block, port, raw);
        return;
    }
    const void *signal = find_signal(building->task, raw->text[0], &source, &type, &width, reason, sizeof reason);
    if (building->task->blocks[source].incomplete)
        return; /* already reported */
    if (!signal) {
        problem(building->problems, raw->line, "block %s: input %s: %s", block->name, to->name, reason);
        return;
    }
    if (type != to->type || width != to->width) {
        problem(building->problems, raw->line, "block %s: input %s takes %s[%u], %s is %s[%u]", block->name, to->name,
                fl_type_name(to->type), (unsigned)to->width, raw->text[0], fl_type_name(type), (unsigned)width);
        return;
    }
    block_wire(block, port, signal);
    if (to->flags & FL_DELAYED && source == index)
        return; /* a block that reads its own output of the step before needs no order */
    building->edges = grown(building->edges, sizeof *building->edges * (building->edge_count + 1));
    building->edges[building->edge_count++] =
        to->flags & FL_DELAYED ? (struct edge){index, source, true, port} : (struct edge){source, index, false, port};
}

static void wire_block(struct building *building, size_t index, const struct block_entry *entry)
{
    char known[160];
    const struct fl_block *block = building->task->blocks[index].block;
    if (building->task->blocks[index].incomplete)
        return;
    for (uint32_t port = 0; port < block->in_count; port++) {
        const struct fl_port *to = &block->in_ports[port];
        const struct raw_value *raw = NULL;
        for (size_t i = 0; i < entry->input_count && !raw; i++)
            if (strcmp(entry->inputs[i].name, to->name) == 0)
                raw = &entry->inputs[i];
        if (raw)
            wire_input(building, index, port, raw);
        else if (!(to->flags & FL_OPTIONAL))
            problem(building->problems, entry->line, "block %s: input %s has no wire: %s", block->name, to->name,
                    to->summary ? to->summary : "it needs one");
    }
    for (size_t i = 0; i < entry->input_count; i++) {
        const struct raw_value *raw = &entry->inputs[i];
        if (port_named(block->in_ports, block->in_count, raw->name, strlen(raw->name)) < 0) {
            list_ports(block->in_ports, block->in_count, known, sizeof known);
            problem(building->problems, raw->line, "block %s: %s has no input %s; it has %s", block->name,
                    block->type->name, raw->name, known);
        }
    }
}

/* --- order --- */

/* Find a loop among the blocks that are left: follow the edges backwards until a block comes again. */
static void report_cycle(struct building *building, const bool *done)
{
    char loop[512] = "";
    const struct task *task = building->task;
    bool *seen = grown(NULL, task->count);
    memset(seen, 0, task->count);
    size_t at = 0;
    while (done[at])
        at++;
    for (bool closing = false;;) {
        if (seen[at]) { /* from here on it is the loop itself */
            if (closing)
                break;
            closing = true;
            memset(seen, 0, task->count);
        }
        seen[at] = true;
        if (closing) {
            char longer[sizeof loop];
            snprintf(longer, sizeof longer, "%.100s%s%.380s", task->blocks[at].block->name, *loop ? " → " : "", loop);
            memcpy(loop, longer, sizeof loop);
        }
        for (size_t e = 0; e < building->edge_count; e++) {
            if (building->edges[e].to == at && !building->edges[e].delayed && !done[building->edges[e].from]) {
                at = building->edges[e].from;
                break;
            }
        }
    }
    problem(building->problems, building->file->blocks[at].line,
            "cycle without delay: %s → %s; put a block delay into one of its wires", task->blocks[at].block->name,
            loop);
    free(seen);
}

/* The first block that is left and has nothing left to wait for, or nothing but readers of delayed inputs with
 * `latching`; their number: there is none. */
static size_t next_block(const struct building *building, const bool *done, bool latching)
{
    size_t next = 0;
    for (; next < building->task->count; next++) {
        bool ready = !done[next];
        for (size_t e = 0; e < building->edge_count && ready; e++) {
            const struct edge *edge = &building->edges[e];
            ready = edge->to != next || done[edge->from] || (latching && edge->delayed);
        }
        if (ready)
            break;
    }
    return next;
}

/* Let the delayed inputs that wait for this block read copies, so that it may run before their blocks. */
static void latch(struct building *building, const bool *done, size_t source)
{
    struct task *task = building->task;
    for (size_t e = 0; e < building->edge_count; e++) {
        const struct edge *edge = &building->edges[e];
        if (edge->to != source || !edge->delayed || done[edge->from])
            continue;
        struct fl_block *block = task->blocks[edge->from].block;
        const struct fl_port *port = &block->in_ports[edge->port];
        struct latch made = {.signal = block->in[edge->port], .bytes = fl_type_size(port->type) * port->width};
        made.kept = fl_allocate(block, made.bytes);
        if (!made.kept)
            abort();
        block_wire(block, edge->port, made.kept);
        task->latches = grown(task->latches, sizeof made * (task->latch_count + 1));
        task->latches[task->latch_count++] = made;
    }
}

/* Order the blocks: sources first, readers of delayed inputs before their sources where that is possible, otherwise as
 * in the file. */
static void order(struct building *building)
{
    struct task *task = building->task;
    struct task_block *ordered = grown(NULL, sizeof *ordered * (task->count + 1));
    bool *done = grown(NULL, task->count + 1);
    memset(done, 0, task->count + 1);
    for (size_t placed = 0; placed < task->count; placed++) {
        size_t next = next_block(building, done, false);
        if (next == task->count && (next = next_block(building, done, true)) < task->count)
            latch(building, done, next);
        if (next == task->count) {
            report_cycle(building, done);
            free(ordered);
            free(done);
            return;
        }
        done[next] = true;
        ordered[placed] = task->blocks[next];
    }
    free(done);
    free(task->blocks);
    task->blocks = ordered;
}

/* --- trigger --- */

static void find_trigger(struct building *building)
{
    const struct task_file *file = building->file;
    struct task *task = building->task;
    for (size_t i = 0; file->trigger && i < task->count && !task->trigger; i++)
        if (strcmp(task->blocks[i].block->name, file->trigger) == 0)
            task->trigger = task->blocks[i].block;
    if (!file->trigger)
        return;
    if (!task->trigger)
        problem(building->problems, file->trigger_line, "trigger: there is no block %s", file->trigger);
    else if (!task->trigger->type->await)
        problem(building->problems, file->trigger_line,
                "trigger: block %s is a %s, which cannot trigger a task; use a block that can, such as udp-receive",
                file->trigger, task->trigger->type->name);
    for (size_t i = 0; i < file->count; i++)
        if (strcmp(file->blocks[i].name, file->trigger) == 0 && file->blocks[i].every > 1)
            problem(building->problems, file->blocks[i].line, "block %s: the trigger runs in every step",
                    file->trigger);
}

/* --- all of it --- */

static char *name_of(const char *path)
{
    const char *base = strrchr(path, '/');
    char *name = strdup(base ? base + 1 : path);
    if (!name)
        abort();
    char *suffix = strrchr(name, '.');
    if (suffix && suffix != name)
        *suffix = '\0';
    return name;
}

void task_build(struct task *task, struct registry *registry, struct problems *problems)
{
    struct task_file file;
    struct building building = {.task = task, .file = &file, .problems = problems};
    *task = (struct task){.name = name_of(problems->file)};
    task_file_read(&file, problems);
    task->period_ns = file.period_ns;
    task->phase_ns = file.phase_ns;
    task->overruns = file.overruns;
    task->overrun = file.overrun;
    task->restart = file.restart;
    task->priority = (int)file.priority;
    task->cpu = (int)file.cpu;
    task->blocks = grown(NULL, sizeof *task->blocks * (file.count + 1));
    for (size_t i = 0; i < file.count; i++)
        make_block(&building, registry, &file.blocks[i]);
    if (task->count == file.count) { /* otherwise each wire of a missing block would add a message */
        for (size_t i = 0; i < file.count; i++)
            wire_block(&building, i, &file.blocks[i]);
        check_devices(&building);
        find_trigger(&building);
        if (!problems->count)
            order(&building);
    }
    free(building.edges);
    task_file_free(&file);
}

void task_free(struct task *task)
{
    for (size_t i = 0; i < task->count; i++)
        block_destroy(task->blocks[i].block);
    free(task->blocks);
    free(task->latches);
    free(task->name);
    *task = (struct task){0};
}

static int64_t actuator_timeout(const struct fl_block *block)
{
    int64_t shortest_ns = inner_shortest(block, actuator_timeout);
    for (uint32_t i = 0; i < block->type->parameter_count; i++) {
        const struct fl_parameter *parameter = &block->type->parameters[i];
        if (!(parameter->flags & FL_ACTUATOR_TIMEOUT))
            continue;
        double seconds = *(const double *)value_of(block, parameter);
        int64_t timeout_ns = seconds < 1e9 ? llround(seconds * 1e9) : INT64_MAX;
        shortest_ns = timeout_ns < shortest_ns ? timeout_ns : shortest_ns;
    }
    return shortest_ns;
}

int64_t task_actuator_timeout(const struct task *task)
{
    int64_t shortest_ns = INT64_MAX;
    for (size_t i = 0; i < task->count; i++) {
        int64_t timeout_ns = actuator_timeout(task->blocks[i].block);
        shortest_ns = timeout_ns < shortest_ns ? timeout_ns : shortest_ns;
    }
    return shortest_ns;
}

static void write_edge(const struct task *task, const struct fl_block *to, uint32_t input, FILE *out)
{
    const char *at = to->in[input];
    for (size_t i = 0; i < task->latch_count; i++)
        if (at == task->latches[i].kept)
            at = task->latches[i].signal;
    for (size_t i = 0; i < task->count; i++) {
        const struct fl_block *from = task->blocks[i].block;
        for (uint32_t port = 0; port < from->out_count; port++) {
            const char *start = from->out[port];
            size_t size = fl_type_size(from->out_ports[port].type);
            if (at < start || at >= start + size * from->out_ports[port].width)
                continue;
            char element[32] = "";
            if (from->out_ports[port].width > 1 && to->in_ports[input].width == 1)
                snprintf(element, sizeof element, "[%zu]", (size_t)(at - start) / size);
            fprintf(out, "  \"%s\" -> \"%s\" [label=\"%s%s → %s\"%s];\n", from->name, to->name,
                    from->out_ports[port].name, element, to->in_ports[input].name,
                    to->in_ports[input].flags & FL_DELAYED ? ", style=dashed" : "");
        }
    }
}

void task_write_dot(const struct task *task, FILE *out)
{
    fprintf(out, "digraph \"%s\" {\n  rankdir=LR;\n  node [shape=box];\n", task->name);
    for (size_t i = 0; i < task->count; i++) {
        const struct task_block *task_block = &task->blocks[i];
        fprintf(out, "  \"%s\" [label=\"%s\\n%s", task_block->block->name, task_block->block->name,
                task_block->block->type->name);
        if (task_block->every > 1)
            fprintf(out, "\\nevery %lld", (long long)task_block->every);
        fprintf(out, "\"];\n");
    }
    for (size_t i = 0; i < task->count; i++)
        for (uint32_t port = 0; port < task->blocks[i].block->in_count; port++)
            write_edge(task, task->blocks[i].block, port, out);
    fprintf(out, "}\n");
}
