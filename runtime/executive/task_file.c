#include "task_file.h"

#include "json.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

/* The kernel's tick falls on whole milliseconds of the clock that releases are multiples of. A step that is due at the
 * same time as the tick begins 20 to 40 us later on a PC/104 board. So the default phase lies between two ticks.
 */
#define OFF_TICK          "500 us"
#define SHORTEST_OFF_TICK "1 ms" /* period */
enum { UNWRITTEN = -1 };
_Static_assert(sizeof(enum overrun) == sizeof(int), "a CHOICE is written as an int");

/* State of the reader. */
struct reading {
    struct task_file *task;
    struct problems *problems;
    struct block_entry *block; /* NULL outside of blocks */
};

enum value { TIME, INTEGER, CHOICE, NAME, MAPPING };

/* A key that a mapping may have. Reader, messages and the page of the reference go by this. */
struct key {
    const char *name;
    enum value value;
    size_t offset;             /* of the member: int64_t of TIME and INTEGER, int of CHOICE, const char * of NAME */
    const char *min, *max;     /* of TIME and INTEGER, inclusive, as a file has them */
    const char *choices;       /* of CHOICE, separated by '|' */
    const char *default_value; /* as a file has it */
    const char *otherwise;     /* what holds without the key where that is no value; neither: it is required */
    void (*then)(struct reading *reading, const yaml_node_t *value); /* reads a MAPPING; checks another value further */
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

/* Whether `node` is a mapping with strings as keys, each given once; reports a problem if not. */
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
            problem(reading->problems, line_of(key), "%s: a key is not a string", what);
            good = false;
        }
        for (size_t before = 0; name && before < i; before++) {
            const char *earlier = text_of(node_at(reading, start[before].key));
            if (earlier && strcmp(earlier, name) == 0) {
                problem(reading->problems, line_of(key), "%s: %s is given twice", what, name);
                good = false;
            }
        }
    }
    return good;
}

static bool is_required(const struct key *key)
{
    return !key->default_value && !key->otherwise;
}

static bool read_number(const struct key *key, const char *text, int64_t *number)
{
    return key->value == TIME ? read_duration(text, number) : read_integer(text, number);
}

/* Read a value that is no mapping into its member of `structure`. */
static void read_value(const struct reading *reading, const struct key *key, const char *text, unsigned line,
                       void *structure)
{
    char *place = (char *)structure + key->offset;
    const char *shown = text ? text : "a list or mapping";
    int64_t number = 0, min = 0, max = 0;
    int choice;
    switch (key->value) {
    case TIME:
    case INTEGER:
        read_number(key, key->min, &min);
        read_number(key, key->max, &max);
        if (!text || !read_number(key, text, &number) || number < min || number > max)
            problem(reading->problems, line, "%s: %s is not a %s from %s to %s", key->name, shown,
                    key->value == TIME ? "time such as 10 ms," : "whole number", key->min, key->max);
        else
            memcpy(place, &number, sizeof number);
        break;
    case CHOICE:
        choice = text ? parameter_choice(key->choices, text) : -1;
        if (choice < 0)
            problem(reading->problems, line, "%s: %s is not one of %s", key->name, shown, key->choices);
        else
            memcpy(place, &choice, sizeof choice);
        break;
    case NAME:
        if (!text)
            problem(reading->problems, line, "%s: %s is not a name", key->name, shown);
        memcpy(place, &text, sizeof text);
        break;
    case MAPPING:
        break;
    }
}

/* Read a mapping whose keys `keys` lists, into `structure`; an entry without a name ends the list. */
static void read_keys(struct reading *reading, const yaml_node_t *mapping, const struct key *keys, void *structure,
                      const char *what)
{
    for (const struct key *key = keys; key->name; key++)
        if (key->default_value)
            read_value(reading, key, key->default_value, 0, structure);
    if (!is_mapping(reading, mapping, what))
        return;
    const yaml_node_pair_t *start = mapping->data.mapping.pairs.start;
    for (size_t i = 0; i < pair_count(mapping); i++) {
        const yaml_node_t *node = node_at(reading, start[i].key), *value = node_at(reading, start[i].value);
        const struct key *key = keys;
        while (key->name && strcmp(key->name, text_of(node)) != 0)
            key++;
        if (key->name) {
            read_value(reading, key, text_of(value), line_of(value), structure);
            if (key->then)
                key->then(reading, value);
            continue;
        }
        char known[128] = "";
        for (key = keys; key->name; key++)
            snprintf(known + strlen(known), sizeof known - strlen(known), "%s%s", *known ? ", " : "", key->name);
        problem(reading->problems, line_of(node), "%s: unknown key %s; known keys: %s", what, text_of(node), known);
    }
    for (const struct key *key = keys; key->name; key++) {
        bool found = !is_required(key);
        for (size_t i = 0; i < pair_count(mapping) && !found; i++)
            found = strcmp(text_of(node_at(reading, start[i].key)), key->name) == 0;
        if (!found)
            problem(reading->problems, line_of(mapping), "%s: %s is missing: %s", what, key->name, key->meaning);
    }
}

static void read_raw(struct reading *reading, const yaml_node_t *value, struct raw_value *raw)
{
    raw->line = line_of(value);
    raw->list = value->type == YAML_SEQUENCE_NODE;
    if (value->type == YAML_MAPPING_NODE) {
        problem(reading->problems, line_of(value), "block %s: %s is a mapping, not a value or a list of values",
                reading->block->name, raw->name);
        return;
    }
    if (!raw->list) {
        raw->text = array(1, sizeof(char *));
        raw->text[raw->count++] = text_of(value);
        return;
    }
    size_t count = (size_t)(value->data.sequence.items.top - value->data.sequence.items.start);
    raw->text = array(count, sizeof(char *));
    for (size_t i = 0; i < count; i++) {
        const yaml_node_t *item = node_at(reading, value->data.sequence.items.start[i]);
        if (text_of(item))
            raw->text[raw->count++] = text_of(item);
        else
            problem(reading->problems, line_of(item), "block %s: %s: a list holds single values only",
                    reading->block->name, raw->name);
    }
}

static struct raw_value *read_values(struct reading *reading, const yaml_node_t *value, const char *what, size_t *count)
{
    if (!is_mapping(reading, value, what))
        return NULL;
    struct raw_value *values = array(pair_count(value), sizeof *values);
    for (*count = 0; *count < pair_count(value); (*count)++) {
        const yaml_node_pair_t *pair = &value->data.mapping.pairs.start[*count];
        values[*count].name = text_of(node_at(reading, pair->key));
        read_raw(reading, node_at(reading, pair->value), &values[*count]);
    }
    return values;
}

static void read_inputs(struct reading *reading, const yaml_node_t *value)
{
    reading->block->inputs = read_values(reading, value, "in", &reading->block->input_count);
}

static void read_parameters(struct reading *reading, const yaml_node_t *value)
{
    reading->block->parameters = read_values(reading, value, "parameters", &reading->block->parameter_count);
}

static void read_bounds(struct reading *reading, const yaml_node_t *value)
{
    reading->block->bounds = read_values(reading, value, "bounds", &reading->block->bound_count);
}

static const struct key block_keys[] = {
    {.name = "type",
     .value = NAME,
     .offset = offsetof(struct block_entry, type),
     .meaning = "which block this is; flotilla-blocks lists them"},
    {.name = "in",
     .value = MAPPING,
     .otherwise = "no wires",
     .then = read_inputs,
     .meaning = "by input: a wire, `block.port`, one element of a wide one, `block.port[2]`, or constants"},
    {.name = "parameters",
     .value = MAPPING,
     .otherwise = "defaults of the block",
     .then = read_parameters,
     .meaning = "by parameter: a value, or a list of values"},
    {.name = "bounds",
     .value = MAPPING,
     .otherwise = "those of the block; a limit of safety stays as it is",
     .then = read_bounds,
     .meaning = "by tunable parameter: least and greatest value that it may be set to while the task runs"},
    {.name = "every",
     .value = INTEGER,
     .offset = offsetof(struct block_entry, every),
     .min = "1",
     .max = "1000000",
     .default_value = "1",
     .meaning = "the block runs in every Nth step of the task"},
    {.name = "offset",
     .value = INTEGER,
     .offset = offsetof(struct block_entry, offset),
     .min = "0",
     .max = "999999",
     .default_value = "0",
     .meaning = "the first step in which it runs; less than `every`"},
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
        *block = (struct block_entry){.name = text_of(key), .line = line_of(key)};
        reading->block = block;
        snprintf(what, sizeof what, "block %s", block->name);
        if (!is_name(block->name))
            problem(reading->problems, block->line, "%s: a name begins with a letter and has no '.', '[', ']', space",
                    what);
        read_keys(reading, node_at(reading, pair->value), block_keys, block, what);
        if (block->offset >= block->every)
            problem(reading->problems, block->line, "%s: offset %lld must be less than every %lld", what,
                    (long long)block->offset, (long long)block->every);
        reading->block = NULL;
    }
    if (!task->count)
        problem(reading->problems, line_of(value), "blocks: the task has none; give at least one");
}

static void note_trigger(struct reading *reading, const yaml_node_t *value)
{
    reading->task->trigger_line = line_of(value);
}

static void check_priority(struct reading *reading, const yaml_node_t *value)
{
    if (reading->task->priority == 1)
        problem(reading->problems, line_of(value),
                "priority: 1 leaves no priority for driver threads; give 0, or 2 to 98");
}

static const struct key task_keys[] = {
    {.name = "period",
     .value = TIME,
     .offset = offsetof(struct task_file, period_ns),
     .min = "50 us",
     .max = "3600 s",
     .meaning = "the time between two steps, such as 10 ms; with a trigger the expected one"},
    {.name = "phase",
     .value = TIME,
     .offset = offsetof(struct task_file, phase_ns),
     .min = "0 us",
     .max = "3600 s",
     .otherwise = OFF_TICK "; 0 with a trigger, or with a period below " SHORTEST_OFF_TICK,
     .meaning = "steps are due this long after each multiple of the period; less than the period, and not with a "
                "trigger"},
    {.name = "trigger",
     .value = NAME,
     .offset = offsetof(struct task_file, trigger),
     .otherwise = "the clock",
     .then = note_trigger,
     .meaning = "the block whose new input makes a step due; it runs in every step"},
    {.name = "priority",
     .value = INTEGER,
     .offset = offsetof(struct task_file, priority),
     .min = "0",
     .max = "98",
     .default_value = "0",
     .then = check_priority,
     .meaning = "of the control thread by SCHED_FIFO, from 2; 0: ordinary scheduling. 1 is left to driver threads"},
    {.name = "cpu",
     .value = INTEGER,
     .offset = offsetof(struct task_file, cpu),
     .min = "0",
     .max = "1023",
     .otherwise = "any that is not isolated",
     .meaning = "the processor that all threads of the task run on, its drivers' too; 0 is the first"},
    {.name = "overrun",
     .value = CHOICE,
     .offset = offsetof(struct task_file, overrun),
     .choices = "skip|catch-up|stop-safe",
     .default_value = "skip",
     .meaning = "what follows a step that ends after the next one was due: skip that, make it at once, or end the task "
                "with outputs in their reset state"},
    {.name = "overruns",
     .value = INTEGER,
     .offset = offsetof(struct task_file, overruns),
     .min = "0",
     .max = "1000000",
     .default_value = "10",
     .meaning = "this many overruns in a row end the task with outputs in their reset state; 0: never"},
    {.name = "restart",
     .value = CHOICE,
     .offset = offsetof(struct task_file, restart),
     .choices = "wait|resume",
     .default_value = "wait",
     .meaning =
         "what actuators do after each start of the task's service, also after a crash: wait until a command was "
         "off, or resume at once, as a flight that goes on"},
    {.name = "blocks",
     .value = MAPPING,
     .then = read_blocks,
     .meaning = "by name: what the task is made of; at least one"},
    {0},
};

static void read_task(struct reading *reading, const yaml_node_t *root)
{
    struct task_file *task = reading->task;
    int64_t off_tick_ns = 0, shortest_ns = 0;
    read_duration(OFF_TICK, &off_tick_ns);
    read_duration(SHORTEST_OFF_TICK, &shortest_ns);
    read_keys(reading, root, task_keys, task, "task");
    if (task->period_ns && task->phase_ns >= task->period_ns)
        problem(reading->problems, line_of(root), "task: phase must be less than the period");
    if (task->trigger && task->phase_ns > 0)
        problem(reading->problems, task->trigger_line, "trigger: a triggered task has no phase; remove one of the two");
    if (task->phase_ns == UNWRITTEN)
        task->phase_ns = task->trigger || task->period_ns < shortest_ns ? 0 : off_tick_ns;
}

void task_file_read(struct task_file *task, struct problems *problems)
{
    yaml_parser_t parser;
    struct reading reading = {.task = task, .problems = problems};
    *task = (struct task_file){.phase_ns = UNWRITTEN, .cpu = TASK_ANY_CPU};
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
            problem(problems, 0, "the file is empty");
    }
    yaml_parser_delete(&parser);
    fclose(file);
}

static void free_raw(struct raw_value *raw, size_t count)
{
    for (size_t i = 0; i < count; i++)
        free(raw[i].text);
    free(raw);
}

void task_file_free(struct task_file *task)
{
    for (size_t i = 0; i < task->count; i++) {
        free_raw(task->blocks[i].inputs, task->blocks[i].input_count);
        free_raw(task->blocks[i].parameters, task->blocks[i].parameter_count);
    }
    free(task->blocks);
    yaml_document_delete(&task->document);
    *task = (struct task_file){0};
}

static void write_keys(const char *above, const struct key *keys, FILE *out)
{
    static const char *const values[] = {
        [TIME] = "time", [INTEGER] = "integer", [CHOICE] = "choice", [NAME] = "name", [MAPPING] = "mapping",
    };
    for (const struct key *key = keys; key->name; key++) {
        fprintf(out, "%s{\"key\": \"%s%s\", \"value\": \"%s\"", key == keys && !*above ? "[" : ",\n ", above, key->name,
                values[key->value]);
        json_member("min", key->min, out);
        json_member("max", key->max, out);
        json_member("choices", key->choices, out);
        json_member("default", key->default_value, out);
        json_member("otherwise", key->otherwise, out);
        json_member("meaning", key->meaning, out);
        fputc('}', out);
    }
}

void task_file_write_keys(FILE *out)
{
    write_keys("", task_keys, out);
    write_keys("blocks.NAME.", block_keys, out);
    fputs("]\n", out);
}
