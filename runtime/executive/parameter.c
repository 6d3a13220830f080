#include "parameter.h"

#include <ctype.h>
#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

static const char *const kind_names[] = {
    [FL_KIND_BOOLEAN] = "true or false",
    [FL_KIND_INTEGER] = "a whole number",
    [FL_KIND_REAL] = "a number",
    [FL_KIND_TEXT] = "a text",
    [FL_KIND_REALS] = "a list of numbers",
    [FL_KIND_TEXTS] = "a list of texts",
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

bool read_real(const char *text, double *value)
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

static int choice_named(const char *choices, const char *name)
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

static bool read_reals(struct fl_block *block, const struct fl_parameter *parameter, const struct written *value,
                       struct fl_reals *reals, const char **outside)
{
    double *numbers = fl_allocate(block, sizeof(double) * (value->count + 1));
    if (!numbers)
        return false;
    for (size_t i = 0; i < value->count; i++) {
        if (!read_real(value->text[i], &numbers[i]))
            return false;
        if (!in_range(parameter, numbers[i]) && !*outside)
            *outside = value->text[i];
    }
    *reals = (struct fl_reals){value->count, numbers};
    return true;
}

static bool read_texts(struct fl_block *block, const struct written *value, struct fl_texts *texts)
{
    const char **copies = fl_allocate(block, sizeof(char *) * (value->count + 1));
    if (!copies)
        return false;
    for (size_t i = 0; i < value->count; i++)
        if (!(copies[i] = kept(block, value->text[i])))
            return false;
    *texts = (struct fl_texts){value->count, copies};
    return true;
}

/* Into a place of the kind's C type. `outside` is set to the first number out of range. */
static bool read_kind(struct fl_block *block, const struct fl_parameter *parameter, const struct written *value,
                      void *place, const char **outside)
{
    const char *text = value->count ? value->text[0] : "";
    if (value->list && parameter->kind != FL_KIND_REALS && parameter->kind != FL_KIND_TEXTS)
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
    case FL_KIND_REAL:
        if (!read_real(text, place))
            return false;
        if (!in_range(parameter, *(double *)place))
            *outside = text;
        return true;
    case FL_KIND_TEXT:
        return (*(const char **)place = kept(block, text)) != NULL;
    case FL_KIND_DEVICE:
        return *text == '/' && (((struct fl_device *)place)->path = kept(block, text)) != NULL;
    case FL_KIND_CHOICE:
        return (*(int *)place = choice_named(parameter->choices, text)) >= 0;
    case FL_KIND_REALS:
        return read_reals(block, parameter, value, place, outside);
    case FL_KIND_TEXTS:
        return read_texts(block, value, place);
    }
    return false;
}

size_t parameter_size(enum fl_kind kind)
{
    static const size_t sizes[] = {
        [FL_KIND_BOOLEAN] = sizeof(bool),
        [FL_KIND_INTEGER] = sizeof(int64_t),
        [FL_KIND_REAL] = sizeof(double),
        [FL_KIND_TEXT] = sizeof(const char *),
        [FL_KIND_REALS] = sizeof(struct fl_reals),
        [FL_KIND_TEXTS] = sizeof(struct fl_texts),
        [FL_KIND_CHOICE] = sizeof(int),
        [FL_KIND_DEVICE] = sizeof(struct fl_device),
        [FL_KIND_UNSIGNED] = sizeof(uint64_t),
    };
    return sizes[kind];
}

bool parameter_set(struct fl_block *block, const struct fl_parameter *parameter, void *parameters,
                   const struct written *value, char *reason, size_t reason_size)
{
    union {
        bool boolean;
        int64_t integer;
        double real;
        struct fl_reals reals;
        int choice;
        const char *text;
    } place = {.integer = 0};
    const char *outside = NULL;
    const char *text = value->count ? value->text[0] : "";
    if (!read_kind(block, parameter, value, &place, &outside)) {
        const char *unit = parameter->unit && *parameter->unit ? parameter->unit : NULL;
        if (parameter->kind == FL_KIND_CHOICE)
            snprintf(reason, reason_size, "%s is none of %s", text, parameter->choices);
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

/* The shortest text that is read as the same number. */
static void write_real(double value, FILE *out)
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
    const struct fl_reals *reals = place;
    const struct fl_texts *texts = place;
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
    case FL_KIND_REAL:
        write_real(*(const double *)place, out);
        break;
    case FL_KIND_TEXT:
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
    case FL_KIND_REALS:
        for (size_t i = 0; i < reals->count; i++) {
            fputs(i ? ", " : "[", out);
            write_real(reals->value[i], out);
        }
        fputs(reals->count ? "]" : "[]", out);
        break;
    case FL_KIND_TEXTS:
        for (size_t i = 0; i < texts->count; i++) {
            fputs(i ? ", " : "[", out);
            write_text(texts->value[i], out);
        }
        fputs(texts->count ? "]" : "[]", out);
        break;
    }
}

void parameters_set(struct fl_block *block, const struct written *written, size_t count, unsigned line,
                    struct problems *problems)
{
    char reason[256];
    const struct fl_block_type *type = block->type;
    void *parameters = (void *)(uintptr_t)block->parameters;
    for (uint32_t i = 0; i < type->parameter_count; i++) {
        const struct fl_parameter *parameter = &type->parameters[i];
        const struct written *value = NULL;
        for (size_t w = 0; w < count && !value; w++)
            if (strcmp(written[w].name, parameter->name) == 0)
                value = &written[w];
        /* An empty fallback is an empty list, or an empty text. */
        const size_t written_fallback = parameter->fallback && *parameter->fallback;
        const struct written fallback = {parameter->name, line, false, written_fallback,
                                         (const char **)&parameter->fallback};
        if (value && !value->list && !value->count)
            continue; /* no value at all, as the reader of the file has said */
        if (!value && !parameter->fallback)
            problem(problems, line, "block %s: parameter %s of %s is missing: %s", block->name, parameter->name,
                    type->name, parameter->summary ? parameter->summary : kind_names[parameter->kind]);
        else if (!parameter_set(block, parameter, parameters, value ? value : &fallback, reason, sizeof reason))
            problem(problems, value ? value->line : line, "block %s: parameter %s: %s", block->name, parameter->name,
                    reason);
    }
    for (size_t w = 0; w < count; w++)
        if (!parameter_find(type, written[w].name, reason, sizeof reason))
            problem(problems, written[w].line, "block %s: %s", block->name, reason);
}
