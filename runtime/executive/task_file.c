#include "task_file.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

/* The kernel's tick is due at whole milliseconds of the clock that releases are multiples of, and the processor does
 * one after the other: in step with it a step begins some 20 us later on a PC/104 board, and up to 40 us. So a task
 * that says nothing about its phase is due between two ticks.
 */
enum { OFF_TICK_NS = 500 * 1000, SHORTEST_OFF_TICK_NS = 1000 * 1000, UNWRITTEN = -1 };

/* What is being read, for the functions below. */
struct reading {
    struct task_file *task;
    struct problems *problems;
    struct block_entry *block; /* NULL outside of blocks */
};

/* A key that a mapping may have. */
struct key {
    const char *name;
    bool required;
    void (*read)(struct reading *reading, const yaml_node_t *value);
    const char *meaning;
};

static unsigned line_of(const yaml_node_t *node)
{
    return (unsigned)node->start_mark.line + 1;
}

static const yaml_node_t *node_at(const struct reading *reading, int index)
{
    return yaml_document_get_node(&reading->task->document, index);
}

static const char *text_of(const yaml_node_t *node)
{
    return node->type == YAML_SCALAR_NODE ? (const char *)node->data.scalar.value : NULL;
}

static void *array(size_t count, size_t size)
{
    void *memory = calloc(count + 1, size);
    if (!memory)
        abort();
    return memory;
}

static size_t pair_count(const yaml_node_t *mapping)
{
    return (size_t)(mapping->data.mapping.pairs.top - mapping->data.mapping.pairs.start);
}

/* Whether `node` is a mapping from texts, each once; if not, that is told. */
static bool is_mapping(const struct reading *reading, const yaml_node_t *node, const char *what)
{
    if (node->type != YAML_MAPPING_NODE) {
        problem(reading->problems, line_of(node), "%s is not a mapping (name: value)", what);
        return false;
    }
    const yaml_node_pair_t *start = node->data.mapping.pairs.start;
    bool good = true;
    for (size_t i = 0; i < pair_count(node); i++) {
        const yaml_node_t *key = node_at(reading, start[i].key);
        const char *name = text_of(key);
        if (!name || !*name) {
            problem(reading->problems, line_of(key), "%s: a key is no text", what);
            good = false;
        }
        for (size_t before = 0; name && before < i; before++) {
            const char *earlier = text_of(node_at(reading, start[before].key));
            if (earlier && strcmp(earlier, name) == 0) {
                problem(reading->problems, line_of(key), "%s: %s is there twice", what, name);
                good = false;
            }
        }
    }
    return good;
}

/* Read a mapping by the table of its keys, which ends with a key without a name. */
static void read_keys(struct reading *reading, const yaml_node_t *mapping, const struct key *keys, const char *what)
{
    if (!is_mapping(reading, mapping, what))
        return;
    const yaml_node_pair_t *start = mapping->data.mapping.pairs.start;
    for (size_t i = 0; i < pair_count(mapping); i++) {
        const yaml_node_t *node = node_at(reading, start[i].key);
        const struct key *key = keys;
        while (key->name && strcmp(key->name, text_of(node)) != 0)
            key++;
        if (key->name) {
            key->read(reading, node_at(reading, start[i].value));
            continue;
        }
        char known[128] = "";
        for (key = keys; key->name; key++)
            snprintf(known + strlen(known), sizeof known - strlen(known), "%s%s", *known ? ", " : "", key->name);
        problem(reading->problems, line_of(node), "%s: unknown key %s; there are %s", what, text_of(node), known);
    }
    for (const struct key *key = keys; key->name; key++) {
        bool found = !key->required;
        for (size_t i = 0; i < pair_count(mapping) && !found; i++)
            found = strcmp(text_of(node_at(reading, start[i].key)), key->name) == 0;
        if (!found)
            problem(reading->problems, line_of(mapping), "%s: %s is missing: %s", what, key->name, key->meaning);
    }
}

/* A whole number between two bounds. */
static void read_bounded(struct reading *reading, const yaml_node_t *value, const char *name, int64_t min, int64_t max,
                         int64_t *out)
{
    int64_t number;
    const char *text = text_of(value);
    if (!text || !read_integer(text, &number) || number < min || number > max)
        problem(reading->problems, line_of(value), "%s: %s is not a whole number from %lld to %lld", name,
                text ? text : "a list", (long long)min, (long long)max);
    else
        *out = number;
}

static void read_written(struct reading *reading, const yaml_node_t *value, struct written *written)
{
    written->line = line_of(value);
    written->list = value->type == YAML_SEQUENCE_NODE;
    if (value->type == YAML_MAPPING_NODE) {
        problem(reading->problems, line_of(value), "block %s: %s is a mapping, not a value or a list of values",
                reading->block->name, written->name);
        return;
    }
    if (!written->list) {
        written->text = array(1, sizeof(char *));
        written->text[written->count++] = text_of(value);
        return;
    }
    size_t count = (size_t)(value->data.sequence.items.top - value->data.sequence.items.start);
    written->text = array(count, sizeof(char *));
    for (size_t i = 0; i < count; i++) {
        const yaml_node_t *item = node_at(reading, value->data.sequence.items.start[i]);
        if (text_of(item))
            written->text[written->count++] = text_of(item);
        else
            problem(reading->problems, line_of(item), "block %s: %s: a list holds single values only",
                    reading->block->name, written->name);
    }
}

static struct written *read_values(struct reading *reading, const yaml_node_t *value, const char *what, size_t *count)
{
    if (!is_mapping(reading, value, what))
        return NULL;
    struct written *values = array(pair_count(value), sizeof *values);
    for (*count = 0; *count < pair_count(value); (*count)++) {
        const yaml_node_pair_t *pair = &value->data.mapping.pairs.start[*count];
        values[*count].name = text_of(node_at(reading, pair->key));
        read_written(reading, node_at(reading, pair->value), &values[*count]);
    }
    return values;
}

static void read_type(struct reading *reading, const yaml_node_t *value)
{
    reading->block->type = text_of(value);
    if (!reading->block->type)
        problem(reading->problems, line_of(value), "block %s: its type is no text", reading->block->name);
}

static void read_every(struct reading *reading, const yaml_node_t *value)
{
    read_bounded(reading, value, "every", 1, 1000000, &reading->block->every);
}

static void read_offset(struct reading *reading, const yaml_node_t *value)
{
    read_bounded(reading, value, "offset", 0, 999999, &reading->block->offset);
}

static void read_inputs(struct reading *reading, const yaml_node_t *value)
{
    reading->block->inputs = read_values(reading, value, "in", &reading->block->input_count);
}

static void read_parameters(struct reading *reading, const yaml_node_t *value)
{
    reading->block->parameters = read_values(reading, value, "parameters", &reading->block->parameter_count);
}

static const struct key block_keys[] = {
    {"type", true, read_type, "which block this is; flotilla-blocks lists them"},
    {"every", false, read_every, NULL},
    {"offset", false, read_offset, NULL},
    {"in", false, read_inputs, NULL},
    {"parameters", false, read_parameters, NULL},
    {0},
};

/* Names appear in "block.port[index]". */
static bool is_name(const char *text)
{
    return *text && !text[strcspn(text, ".[] \t")] && !strchr("0123456789+-", *text);
}

static void read_blocks(struct reading *reading, const yaml_node_t *value)
{
    struct task_file *task = reading->task;
    if (!is_mapping(reading, value, "blocks"))
        return;
    task->blocks = array(pair_count(value), sizeof *task->blocks);
    for (size_t i = 0; i < pair_count(value); i++) {
        char what[128];
        const yaml_node_pair_t *pair = &value->data.mapping.pairs.start[i];
        const yaml_node_t *key = node_at(reading, pair->key);
        struct block_entry *block = &task->blocks[task->count++];
        *block = (struct block_entry){.name = text_of(key), .line = line_of(key), .every = 1};
        reading->block = block;
        snprintf(what, sizeof what, "block %s", block->name);
        if (!is_name(block->name))
            problem(reading->problems, block->line, "%s: a name begins with a letter and has no '.', '[', ']', space",
                    what);
        read_keys(reading, node_at(reading, pair->value), block_keys, what);
        if (block->offset >= block->every)
            problem(reading->problems, block->line, "%s: offset %lld is not below every %lld", what,
                    (long long)block->offset, (long long)block->every);
        reading->block = NULL;
    }
    if (!task->count)
        problem(reading->problems, line_of(value), "blocks: there is none");
}

static void read_period(struct reading *reading, const yaml_node_t *value)
{
    int64_t period_ns;
    const char *text = text_of(value);
    if (!text || !read_duration(text, &period_ns))
        problem(reading->problems, line_of(value), "period: %s is not a time such as 10 ms", text ? text : "a list");
    else if (period_ns < 50 * 1000 || period_ns > INT64_C(3600000000000))
        problem(reading->problems, line_of(value), "period: %s is not from 50 us to 3600 s", text);
    else
        reading->task->period_ns = period_ns;
}

static void read_phase(struct reading *reading, const yaml_node_t *value)
{
    const char *text = text_of(value);
    if (!text || !read_duration(text, &reading->task->phase_ns) || reading->task->phase_ns < 0) {
        problem(reading->problems, line_of(value), "phase: %s is not a time such as 5 ms", text ? text : "a list");
        reading->task->phase_ns = 0;
    }
}

static void read_trigger(struct reading *reading, const yaml_node_t *value)
{
    reading->task->trigger = text_of(value);
    reading->task->trigger_line = line_of(value);
    if (!reading->task->trigger)
        problem(reading->problems, line_of(value), "trigger: a list is not the name of a block");
}

static void read_priority(struct reading *reading, const yaml_node_t *value)
{
    int64_t priority = 0;
    read_bounded(reading, value, "priority", 0, 98, &priority);
    if (priority == 1)
        problem(reading->problems, line_of(value), "priority: 1 leaves none below for the drivers; 0, or 2 to 98");
    else
        reading->task->priority = priority;
}

static void read_overrun(struct reading *reading, const yaml_node_t *value)
{
    static const char *const names[] = {"skip", "catch-up", "stop-safe"};
    const char *text = text_of(value);
    for (size_t i = 0; text && i < sizeof names / sizeof names[0]; i++) {
        if (strcmp(text, names[i]) == 0) {
            reading->task->overrun = (enum overrun)i;
            return;
        }
    }
    problem(reading->problems, line_of(value), "overrun: %s is none of skip, catch-up, stop-safe",
            text ? text : "a list");
}

static void read_overruns(struct reading *reading, const yaml_node_t *value)
{
    read_bounded(reading, value, "overruns", 0, 1000000, &reading->task->overruns);
}

static const struct key task_keys[] = {
    {"period", true, read_period, "the time between two steps, such as 10 ms"},
    {"phase", false, read_phase, NULL},
    {"trigger", false, read_trigger, NULL},
    {"priority", false, read_priority, NULL},
    {"overrun", false, read_overrun, NULL},
    {"overruns", false, read_overruns, NULL},
    {"blocks", true, read_blocks, "what the task is made of"},
    {0},
};

static void read_task(struct reading *reading, const yaml_node_t *root)
{
    struct task_file *task = reading->task;
    read_keys(reading, root, task_keys, "task");
    if (task->period_ns && task->phase_ns >= task->period_ns)
        problem(reading->problems, line_of(root), "task: phase is not below the period");
    if (task->trigger && task->phase_ns > 0)
        problem(reading->problems, task->trigger_line, "trigger: a step that is due when something comes has no phase");
    if (task->phase_ns == UNWRITTEN)
        task->phase_ns = task->trigger || task->period_ns < SHORTEST_OFF_TICK_NS ? 0 : OFF_TICK_NS;
}

void task_file_read(struct task_file *task, struct problems *problems)
{
    yaml_parser_t parser;
    struct reading reading = {.task = task, .problems = problems};
    *task = (struct task_file){.phase_ns = UNWRITTEN, .overrun = OVERRUN_SKIP, .overruns = 10};
    FILE *file = fopen(problems->file, "re");
    if (!file) {
        problem(problems, 0, "%s", strerror(errno));
        return;
    }
    if (!yaml_parser_initialize(&parser))
        abort();
    yaml_parser_set_input_file(&parser, file);
    if (!yaml_parser_load(&parser, &task->document)) {
        problem(problems, (unsigned)parser.problem_mark.line + 1, "%s", parser.problem ? parser.problem : "not YAML");
        memset(&task->document, 0, sizeof task->document);
    } else {
        const yaml_node_t *root = yaml_document_get_root_node(&task->document);
        if (root)
            read_task(&reading, root);
        else
            problem(problems, 0, "it is empty");
    }
    yaml_parser_delete(&parser);
    fclose(file);
}

static void free_written(struct written *written, size_t count)
{
    for (size_t i = 0; i < count; i++)
        free(written[i].text);
    free(written);
}

void task_file_free(struct task_file *task)
{
    for (size_t i = 0; i < task->count; i++) {
        free_written(task->blocks[i].inputs, task->blocks[i].input_count);
        free_written(task->blocks[i].parameters, task->blocks[i].parameter_count);
    }
    free(task->blocks);
    yaml_document_delete(&task->document);
    *task = (struct task_file){0};
}
