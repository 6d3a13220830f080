#include "parameter.h"

#include "core/service.h"

#include <ctype.h>
#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

static const char *const kind_names[] = {
    [FL_KIND_BOOLEAN] = "true or false",
    [FL_KIND_INTEGER] = "a whole number",
    [FL_KIND_DOUBLE] = "a number",
    [FL_KIND_STRING] = "a string",
    [FL_KIND_DOUBLES] = "a list of numbers",
    [FL_KIND_STRINGS] = "a list of strings",
    [FL_KIND_CHOICE] = "one of its choices",
    [FL_KIND_DEVICE] = "a device's path",
    [FL_KIND_UNSIGNED] = "a whole number from 0",
};

bool read_integer(const char *text, int64_t *value)
{
    char *end;
    const char *digits = text + (*text == '-' || *text == '+');
    bool hexadecimal = digits[0] == '0' && (digits[1] == 'x' || digits[1] == 'X');
    if (!isdigit((unsigned char)*digits))
        return false;
    errno = 0;
    long long read = strtoll(text, &end, hexadecimal ? 16 : 10);
    if (errno || *end)
        return false;
    *value = read;
    return true;
}

bool read_unsigned(const char *text, uint64_t *value)
{
    char *end;
    const char *digits = text + (*text == '+');
    bool hexadecimal = digits[0] == '0' && (digits[1] == 'x' || digits[1] == 'X');
    if (!isdigit((unsigned char)*digits))
        return false;
    errno = 0;
    unsigned long long read = strtoull(text, &end, hexadecimal ? 16 : 10);
    if (errno || *end)
        return false;
    *value = read;
    return true;
}

bool read_double(const char *text, double *value)
{
    char *end;
    if (!*text || isspace((unsigned char)*text))
        return false;
    errno = 0;
    double read = strtod(text, &end);
    if (*end || !isfinite(read))
        return false;
    *value = read;
    return true;
}

bool read_duration(const char *text, int64_t *value_ns)
{
    static const struct {
        const char *unit;
        double ns;
    } units[] = {{"ns", 1}, {"us", 1e3}, {"µs", 1e3}, {"ms", 1e6}, {"s", 1e9}};
    char *end;
    double number = strtod(text, &end);
    if (end == text || !isfinite(number) || fabs(number) > 1e9)
        return false;
    while (*end == ' ')
        end++;
    for (size_t i = 0; i < sizeof units / sizeof units[0]; i++) {
        if (strcmp(end, units[i].unit) == 0) {
            *value_ns = (int64_t)llround(number * units[i].ns);
            return true;
        }
    }
    return false;
}

static bool read_boolean(const char *text, bool *value)
{
    *value = strcmp(text, "true") == 0;
    return *value || strcmp(text, "false") == 0;
}

int parameter_choice(const char *choices, const char *name)
{
    size_t length = strlen(name);
    for (int index = 0;; index++) {
        size_t until = strcspn(choices, "|");
        if (until == length && strncmp(choices, name, length) == 0)
            return index;
        if (!choices[until])
            return -1;
        choices += until + 1;
    }
}

static bool in_range(const struct fl_parameter *parameter, double value)
{
    return parameter->min == parameter->max || (value >= parameter->min && value <= parameter->max);
}

static const char *kept(struct fl_block *block, const char *text)
{
    size_t bytes = strlen(text) + 1;
    char *copy = fl_allocate(block, bytes);
    return copy ? memcpy(copy, text, bytes) : NULL;
}

static bool read_doubles(struct fl_block *block, const struct fl_parameter *parameter, const struct raw_value *value,
                         struct fl_doubles *doubles, const char **outside)
{
    double *numbers = fl_allocate(block, sizeof(double) * (value->count + 1));
    if (!numbers)
        return false;
    for (size_t i = 0; i < value->count; i++) {
        if (!read_double(value->text[i], &numbers[i]))
            return false;
        if (!in_range(parameter, numbers[i]) && !*outside)
            *outside = value->text[i];
    }
    *doubles = (struct fl_doubles){value->count, numbers};
    return true;
}

static bool read_strings(struct fl_block *block, const struct raw_value *value, struct fl_strings *strings)
{
    const char **copies = fl_allocate(block, sizeof(char *) * (value->count + 1));
    if (!copies)
        return false;
    for (size_t i = 0; i < value->count; i++)
        if (!(copies[i] = kept(block, value->text[i])))
            return false;
    *strings = (struct fl_strings){value->count, copies};
    return true;
}

/* Read a value into `place`, of the C type of the kind. `outside` is set to the first number that is out of range. */
static bool read_kind(struct fl_block *block, const struct fl_parameter *parameter, const struct raw_value *value,
                      void *place, const char **outside)
{
    const char *text = value->count ? value->text[0] : "";
    if (value->list && parameter->kind != FL_KIND_DOUBLES && parameter->kind != FL_KIND_STRINGS)
        return false;
    switch (parameter->kind) {
    case FL_KIND_BOOLEAN:
        return read_boolean(text, place);
    case FL_KIND_INTEGER:
        if (!read_integer(text, place))
            return false;
        if (!in_range(parameter, (double)*(int64_t *)place))
            *outside = text;
        return true;
    case FL_KIND_UNSIGNED:
        if (!read_unsigned(text, place))
            return false;
        if (!in_range(parameter, (double)*(uint64_t *)place))
            *outside = text;
        return true;
    case FL_KIND_DOUBLE:
        if (!read_double(text, place))
            return false;
        if (!in_range(parameter, *(double *)place))
            *outside = text;
        return true;
    case FL_KIND_STRING:
        return (*(const char **)place = kept(block, text)) != NULL;
    case FL_KIND_DEVICE:
        return *text == '/' && (((struct fl_device *)place)->path = kept(block, text)) != NULL;
    case FL_KIND_CHOICE:
        return (*(int *)place = parameter_choice(parameter->choices, text)) >= 0;
    case FL_KIND_DOUBLES:
        return read_doubles(block, parameter, value, place, outside);
    case FL_KIND_STRINGS:
        return read_strings(block, value, place);
    }
    return false;
}

size_t parameter_size(enum fl_kind kind)
{
    static const size_t sizes[] = {
        [FL_KIND_BOOLEAN] = sizeof(bool),
        [FL_KIND_INTEGER] = sizeof(int64_t),
        [FL_KIND_DOUBLE] = sizeof(double),
        [FL_KIND_STRING] = sizeof(const char *),
        [FL_KIND_DOUBLES] = sizeof(struct fl_doubles),
        [FL_KIND_STRINGS] = sizeof(struct fl_strings),
        [FL_KIND_CHOICE] = sizeof(int),
        [FL_KIND_DEVICE] = sizeof(struct fl_device),
        [FL_KIND_UNSIGNED] = sizeof(uint64_t),
    };
    return sizes[kind];
}

bool parameter_set(struct fl_block *block, const struct fl_parameter *parameter, void *parameters,
                   const struct raw_value *value, char *reason, size_t reason_size)
{
    union {
        bool boolean;
        int64_t integer;
        double number;
        struct fl_doubles doubles;
        int choice;
        const char *text;
    } place = {.integer = 0};
    const char *outside = NULL;
    const char *text = value->count ? value->text[0] : "";
    if (!read_kind(block, parameter, value, &place, &outside)) {
        const char *unit = parameter->unit && *parameter->unit ? parameter->unit : NULL;
        if (parameter->kind == FL_KIND_CHOICE)
            snprintf(reason, reason_size, "%s is not one of %s", text, parameter->choices);
        else
            snprintf(reason, reason_size, "%s%s is not %s%s%s", value->list ? "the list beginning with " : "",
                     *text ? text : "nothing", kind_names[parameter->kind], unit ? " in " : "", unit ? unit : "");
        return false;
    }
    if (outside) {
        snprintf(reason, reason_size, "%s is outside %g to %g%s%s", outside, parameter->min, parameter->max,
                 parameter->unit ? " " : "", parameter->unit ? parameter->unit : "");
        return false;
    }
    memcpy((char *)parameters + parameter->offset, &place, parameter_size(parameter->kind));
    return true;
}

static const struct fl_parameter *parameter_named(const struct fl_block_type *type, const char *name)
{
    for (uint32_t i = 0; i < type->parameter_count; i++)
        if (strcmp(type->parameters[i].name, name) == 0)
            return &type->parameters[i];
    return NULL;
}

const struct fl_parameter *parameter_find(const struct fl_block_type *type, const char *name, char *reason,
                                          size_t reason_size)
{
    const struct fl_parameter *parameter = parameter_named(type, name);
    if (parameter)
        return parameter;
    int used = snprintf(reason, reason_size, "%s has no parameter %s; it has ", type->name, name);
    for (uint32_t i = 0; i < type->parameter_count && used >= 0 && (size_t)used < reason_size; i++)
        used += snprintf(reason + used, reason_size - (size_t)used, "%s%s", i ? ", " : "", type->parameters[i].name);
    if (!type->parameter_count && (size_t)used < reason_size)
        snprintf(reason + used, reason_size - (size_t)used, "none");
    return NULL;
}

/* Write the shortest string that reads back as the same number. */
static void write_double(double value, FILE *out)
{
    char text[32];
    for (int digits = 15; digits <= 17; digits++) {
        snprintf(text, sizeof text, "%.*g", digits, value);
        double read = strtod(text, NULL);
        if (!(read < value) && !(read > value))
            break;
    }
    fputs(text, out);
}

static void write_text(const char *text, FILE *out)
{
    fputc('"', out);
    for (; *text; text++)
        fputc(iscntrl((unsigned char)*text) ? ' ' : *text, out); /* a line stays a line */
    fputc('"', out);
}

void parameter_write(const struct fl_parameter *parameter, const void *parameters, FILE *out)
{
    const void *place = (const char *)parameters + parameter->offset;
    const struct fl_doubles *doubles = place;
    const struct fl_strings *strings = place;
    const char *choices = parameter->choices;
    switch (parameter->kind) {
    case FL_KIND_BOOLEAN:
        fputs(*(const bool *)place ? "true" : "false", out);
        break;
    case FL_KIND_INTEGER:
        fprintf(out, "%" PRId64, *(const int64_t *)place);
        break;
    case FL_KIND_UNSIGNED:
        fprintf(out, "%" PRIu64, *(const uint64_t *)place);
        break;
    case FL_KIND_DOUBLE:
        write_double(*(const double *)place, out);
        break;
    case FL_KIND_STRING:
        write_text(*(const char *const *)place, out);
        break;
    case FL_KIND_DEVICE:
        write_text(((const struct fl_device *)place)->path, out);
        break;
    case FL_KIND_CHOICE:
        for (int before = *(const int *)place; before > 0; before--)
            choices += strcspn(choices, "|") + 1;
        fprintf(out, "%.*s", (int)strcspn(choices, "|"), choices);
        break;
    case FL_KIND_DOUBLES:
        for (size_t i = 0; i < doubles->count; i++) {
            fputs(i ? ", " : "[", out);
            write_double(doubles->value[i], out);
        }
        fputs(doubles->count ? "]" : "[]", out);
        break;
    case FL_KIND_STRINGS:
        for (size_t i = 0; i < strings->count; i++) {
            fputs(i ? ", " : "[", out);
            write_text(strings->value[i], out);
        }
        fputs(strings->count ? "]" : "[]", out);
        break;
    }
}

void parameters_set(struct fl_block *block, const struct raw_value *raw, size_t count, unsigned line,
                    struct problems *problems)
{
    char reason[256];
    const struct fl_block_type *type = block->type;
    void *parameters = (void *)(uintptr_t)block->parameters;
    for (uint32_t i = 0; i < type->parameter_count; i++) {
        const struct fl_parameter *parameter = &type->parameters[i];
        const struct raw_value *value = NULL;
        for (size_t w = 0; w < count && !value; w++)
            if (strcmp(raw[w].name, parameter->name) == 0)
                value = &raw[w];
        /* An empty default is an empty list or an empty string. */
        const size_t default_count = parameter->default_value && *parameter->default_value;
        const struct raw_value default_value = {parameter->name, line, false, default_count,
                                                (const char **)&parameter->default_value};
        block->service->given[i] = value != NULL;
        if (value && !value->list && !value->count)
            continue; /* no value; the reader of the file has reported it */
        if (!value && !parameter->default_value)
            problem(problems, line, "block %s: parameter %s of %s is missing: %s", block->name, parameter->name,
                    type->name, parameter->summary ? parameter->summary : kind_names[parameter->kind]);
        else if (!parameter_set(block, parameter, parameters, value ? value : &default_value, reason, sizeof reason))
            problem(problems, value ? value->line : line, "block %s: parameter %s: %s", block->name, parameter->name,
                    reason);
    }
    for (size_t w = 0; w < count; w++)
        if (!parameter_find(type, raw[w].name, reason, sizeof reason))
            problem(problems, raw[w].line, "block %s: %s", block->name, reason);
}

double parameter_number(enum fl_kind kind, const void *place)
{
    switch (kind) {
    case FL_KIND_BOOLEAN:
        return *(const bool *)place;
    case FL_KIND_INTEGER:
        return (double)*(const int64_t *)place;
    case FL_KIND_UNSIGNED:
        return (double)*(const uint64_t *)place;
    default:
        return *(const double *)place;
    }
}

static bool has_bounds(const struct fl_parameter *parameter)
{
    enum fl_kind kind = parameter->kind;
    return parameter->flags & FL_TUNABLE &&
           (kind == FL_KIND_DOUBLE || kind == FL_KIND_INTEGER || kind == FL_KIND_UNSIGNED);
}

void parameters_bound(struct fl_block *block, const struct raw_value *raw, size_t count, struct problems *problems)
{
    char reason[256];
    for (size_t i = 0; i < count; i++) {
        const struct fl_parameter *parameter = parameter_find(block->type, raw[i].name, reason, sizeof reason);
        double least, greatest;
        if (!parameter) {
            problem(problems, raw[i].line, "block %s: bounds: %s", block->name, reason);
        } else if (!has_bounds(parameter)) {
            problem(problems, raw[i].line, "block %s: bounds: %s is no number that can be set while the task runs",
                    block->name, parameter->name);
        } else if (!raw[i].list || raw[i].count != 2 || !read_double(raw[i].text[0], &least) ||
                   !read_double(raw[i].text[1], &greatest) || least > greatest) {
            problem(problems, raw[i].line, "block %s: bounds: %s: is not a list of the least and the greatest value",
                    block->name, parameter->name);
        } else {
            block->service->bounds[parameter - block->type->parameters] = (struct fl_bounds){true, least, greatest};
        }
    }
}
