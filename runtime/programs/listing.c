#define _GNU_SOURCE
#include "listing.h"

#include "executive/block.h"
#include "executive/json.h"
#include "named_block.h"

#include <stdlib.h>
#include <string.h>

enum { REASON_BYTES = 512 };

static const char *const kinds[] = {
    [FL_KIND_BOOLEAN] = "boolean", [FL_KIND_INTEGER] = "integer", [FL_KIND_UNSIGNED] = "unsigned",
    [FL_KIND_DOUBLE] = "double",   [FL_KIND_STRING] = "string",   [FL_KIND_DOUBLES] = "doubles",
    [FL_KIND_STRINGS] = "strings", [FL_KIND_CHOICE] = "choice",   [FL_KIND_DEVICE] = "device",
};

static const struct {
    unsigned flag;
    const char *name;
} needs[] = {{FL_CAN_INTERFACE, "can"}, {FL_IO_PORTS, "io-ports"}, {FL_CAMERA, "camera"}};

/* What a task with the parameter's block needs a permission for; NULL: nothing. */
static const char *need_of(const struct fl_parameter *parameter)
{
    for (size_t i = 0; i < sizeof needs / sizeof needs[0]; i++)
        if (parameter->flags & needs[i].flag)
            return needs[i].name;
    return NULL;
}

/* A block to list: its type, and its ports if parameters were given. */
struct listed {
    const struct fl_block_type *type;
    const struct fl_port *inputs, *outputs;
    uint32_t input_count, output_count;
    bool configured;
};

static const char *given(const char *text)
{
    return text ? text : "";
}

/* --- for people --- */

static void print_ports(const char *title, const struct fl_port *ports, uint32_t count, FILE *out)
{
    for (uint32_t i = 0; i < count; i++) {
        const struct fl_port *port = &ports[i];
        char type[32];
        snprintf(type, sizeof type, port->width > 1 ? "%s[%u]" : "%s", fl_type_name(port->type), (unsigned)port->width);
        fprintf(out, "  %-9s %-16s %-12s %-8s %s%s\n", title, port->name, type, given(port->unit), given(port->summary),
                port->flags & FL_OPTIONAL ? " (optional)" : "");
    }
}

static void print_parameters(const struct fl_block_type *type, FILE *out)
{
    for (uint32_t i = 0; i < type->parameter_count; i++) {
        const struct fl_parameter *parameter = &type->parameters[i];
        fprintf(out, "  %-9s %-16s %-12s %-8s %s", "parameter", parameter->name, kinds[parameter->kind],
                given(parameter->unit), given(parameter->summary));
        if (parameter->choices)
            fprintf(out, "; one of %s", parameter->choices);
        if (parameter->min < parameter->max)
            fprintf(out, "; %g to %g", parameter->min, parameter->max);
        fprintf(out, parameter->default_value ? "; default %s" : "; required", given(parameter->default_value));
        if (need_of(parameter))
            fprintf(out, "; needs permission: %s", need_of(parameter));
        fputs(parameter->flags & FL_TUNABLE ? "; tunable\n" : "\n", out);
    }
}

static void print_block(const struct listed *listed, FILE *out)
{
    const struct fl_block_type *type = listed->type;
    fprintf(out, "%s: %s\n", type->name, given(type->summary));
    if (type->source)
        fprintf(out, "  source    %s\n", type->source);
    print_ports("input", listed->inputs, listed->input_count, out);
    print_ports("output", listed->outputs, listed->output_count, out);
    if (type->configure && !listed->configured)
        fputs("  further ports may depend on the parameters: write PARAMETER=VALUE behind the block\n", out);
    print_parameters(type, out);
}

/* --- for programs --- */

static void write_flag(const char *name, bool flag, FILE *out)
{
    if (flag)
        fprintf(out, ", \"%s\": true", name);
}

/* Begin an object, or a further one. */
static void write_name(const char *name, bool first, FILE *out)
{
    fputs(first ? "{\"name\": " : ",\n  {\"name\": ", out);
    json_string(name, out);
}

static void write_ports(const char *title, const struct fl_port *ports, uint32_t count, FILE *out)
{
    fprintf(out, ",\n \"%s\": [", title);
    for (uint32_t i = 0; i < count; i++) {
        write_name(ports[i].name, !i, out);
        json_member("type", fl_type_name(ports[i].type), out);
        json_number("width", ports[i].width, out);
        json_member("unit", ports[i].unit, out);
        json_member("summary", ports[i].summary, out);
        write_flag("optional", ports[i].flags & FL_OPTIONAL, out);
        write_flag("delayed", ports[i].flags & FL_DELAYED, out);
        write_flag("refusals", ports[i].flags & FL_REFUSALS, out);
        fputc('}', out);
    }
    fputc(']', out);
}

static void write_parameters(const struct fl_block_type *type, FILE *out)
{
    fputs(",\n \"parameters\": [", out);
    for (uint32_t i = 0; i < type->parameter_count; i++) {
        const struct fl_parameter *parameter = &type->parameters[i];
        write_name(parameter->name, !i, out);
        json_member("kind", kinds[parameter->kind], out);
        json_member("unit", parameter->unit, out);
        json_member("summary", parameter->summary, out);
        if (parameter->min < parameter->max) {
            json_number("min", parameter->min, out);
            json_number("max", parameter->max, out);
        }
        json_member("choices", parameter->choices, out);
        json_member("default", parameter->default_value, out);
        write_flag("required", !parameter->default_value, out);
        write_flag("tunable", parameter->flags & FL_TUNABLE, out);
        write_flag("exclusive", parameter->flags & FL_EXCLUSIVE || parameter->kind == FL_KIND_DEVICE, out);
        write_flag("timeout", parameter->flags & FL_ACTUATOR_TIMEOUT, out);
        json_member("needs", need_of(parameter), out);
        fputc('}', out);
    }
    fputs("]}", out);
}

static void write_block(const struct listed *listed, FILE *out)
{
    const struct fl_block_type *type = listed->type;
    fputs("{\"name\": ", out);
    json_string(type->name, out);
    json_member("summary", type->summary, out);
    json_member("source", type->source, out);
    write_flag("configures", type->configure, out);
    write_flag("triggers", type->await, out);
    write_flag("actuates", type->safe, out);
    write_ports("inputs", listed->inputs, listed->input_count, out);
    write_ports("outputs", listed->outputs, listed->output_count, out);
    write_parameters(type, out);
}

/* --- both --- */

static struct listed as_typed(const struct fl_block_type *type)
{
    return (struct listed){type, type->inputs, type->outputs, type->input_count, type->output_count, false};
}

static struct listed as_configured(const struct fl_block *block)
{
    return (struct listed){block->type, block->in_ports, block->out_ports, block->in_count, block->out_count, true};
}

static void write_listed(const struct listed *listed, bool json, int index, FILE *out)
{
    if (json && index)
        fputs(",\n", out);
    (json ? write_block : print_block)(listed, out);
}

static bool write_named(struct registry *registry, struct named_block *named, bool json, int index, FILE *out)
{
    char reason[REASON_BYTES];
    struct listed listed = as_typed(named->type);
    if ((json || named->word_count) && !named_block_configure(named, registry, reason, sizeof reason)) {
        fprintf(registry->out, "%s: %s\n", named->type->name, reason);
        return false;
    }
    if (named->block)
        listed = as_configured(named->block);
    write_listed(&listed, json, index, out);
    return true;
}

bool listing_write(struct registry *registry, char *const *words, int count, bool json, FILE *out)
{
    struct named_block *blocks = calloc((size_t)count + 1, sizeof *blocks);
    if (!blocks)
        abort();
    const int found = named_blocks(registry, words, count, blocks);
    bool good = found >= 0;
    if (json)
        fputc('[', out);
    for (size_t i = 0; i < registry->count && !count; i++) {
        const struct listed listed = as_typed(registry->types[i]);
        if (json)
            write_listed(&listed, json, (int)i, out);
        else
            fprintf(out, "%-20s %s\n", listed.type->name, given(listed.type->summary));
    }
    for (int i = 0; i < found; i++) {
        good = write_named(registry, &blocks[i], json, i, out) && good;
        block_destroy(blocks[i].outer);
    }
    if (json)
        fputs("]\n", out);
    free(blocks);
    return good;
}
