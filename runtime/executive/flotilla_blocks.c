/* flotilla-blocks: lists the blocks that tasks can use. */
#define _GNU_SOURCE
#include "block.h"
#include "legacy_code.h"
#include "registry.h"

#include <getopt.h>
#include <string.h>

static const char usage[] =
    "usage: flotilla-blocks [--blocks DIRECTORY] [NAME]...\n"
    "       flotilla-blocks [--blocks DIRECTORY] --legacy-code [--out DIRECTORY] [NAME [PARAMETER=VALUE]...]...\n"
    "List all blocks, a line each; of the named ones all ports and parameters.\n"
    "  --legacy-code       make Simulink blocks of all or of the named ones: write a script for its Legacy Code Tool,\n"
    "                      and the C files that it takes; parameters with a VALUE are fixed, the others Simulink's\n"
    "  --out DIRECTORY     where to (default: .)\n"
    "  --blocks DIRECTORY  plug-ins with further blocks (default: " FLOTILLA_BLOCKS "); several are separated by ':'\n"
    "  --help, --version\n";

static const char *const kinds[] = {
    [FL_KIND_BOOLEAN] = "boolean", [FL_KIND_INTEGER] = "integer", [FL_KIND_UNSIGNED] = "unsigned",
    [FL_KIND_REAL] = "real",       [FL_KIND_TEXT] = "text",       [FL_KIND_REALS] = "reals",
    [FL_KIND_TEXTS] = "texts",     [FL_KIND_CHOICE] = "choice",   [FL_KIND_DEVICE] = "device",
};

static const char *given(const char *text)
{
    return text ? text : "";
}

static void print_ports(const char *title, const struct fl_port *ports, uint32_t count)
{
    for (uint32_t i = 0; i < count; i++) {
        const struct fl_port *port = &ports[i];
        char type[32];
        snprintf(type, sizeof type, port->width > 1 ? "%s[%u]" : "%s", fl_type_name(port->type), (unsigned)port->width);
        printf("  %-9s %-16s %-12s %-8s %s%s\n", title, port->name, type, given(port->unit), given(port->summary),
               port->flags & FL_OPTIONAL ? " (optional)" : "");
    }
}

static void print_parameters(const struct fl_block_type *type)
{
    for (uint32_t i = 0; i < type->parameter_count; i++) {
        const struct fl_parameter *parameter = &type->parameters[i];
        printf("  %-9s %-16s %-12s %-8s %s", "parameter", parameter->name, kinds[parameter->kind],
               given(parameter->unit), given(parameter->summary));
        if (parameter->choices)
            printf("; one of %s", parameter->choices);
        if (parameter->min != parameter->max)
            printf("; %g to %g", parameter->min, parameter->max);
        printf(parameter->fallback ? "; default %s" : "; required", given(parameter->fallback));
        printf(parameter->flags & FL_TUNABLE ? "; tunable\n" : "\n");
    }
}

static void print_type(const struct fl_block_type *type)
{
    printf("%s: %s\n", type->name, given(type->summary));
    if (type->source)
        printf("  source    %s\n", type->source);
    print_ports("input", type->inputs, type->input_count);
    print_ports("output", type->outputs, type->output_count);
    if (type->configure)
        printf("  further ports depend on the parameters\n");
    print_parameters(type);
}

int main(int argc, char **argv)
{
    static const struct option options[] = {
        {"blocks", required_argument, NULL, 'b'}, {"legacy-code", no_argument, NULL, 'l'},
        {"out", required_argument, NULL, 'o'},    {"help", no_argument, NULL, 'h'},
        {"version", no_argument, NULL, 'v'},      {0}};
    const char *blocks = FLOTILLA_BLOCKS, *out = ".";
    bool legacy_code = false;
    struct registry registry = {0};
    int status = 0;
    for (int option; (option = getopt_long(argc, argv, "", options, NULL)) != -1;) {
        switch (option) {
        case 'b':
            blocks = optarg;
            break;
        case 'l':
            legacy_code = true;
            break;
        case 'o':
            out = optarg;
            break;
        case 'h':
            fputs(usage, stdout);
            return 0;
        case 'v':
            printf("flotilla-blocks " FLOTILLA_VERSION ", interface %u of blocks\n", FL_ABI);
            return 0;
        default:
            fputs(usage, stderr);
            return 2;
        }
    }
    unsigned faults = registry_fill(&registry, blocks, stderr);
    faults += registry_load_plugins(&registry);
    if (faults)
        status = 1;
    if (legacy_code && !legacy_code_write(&registry, argv + optind, argc - optind, out))
        status = 2;
    for (size_t i = 0; i < registry.count && optind == argc && !legacy_code; i++)
        printf("%-20s %s\n", registry.types[i]->name, given(registry.types[i]->summary));
    for (int i = optind; i < argc && !legacy_code; i++) {
        const struct fl_block_type *type = registry_find(&registry, argv[i]);
        const char *nearest = type ? NULL : registry_nearest(&registry, argv[i]);
        if (type) {
            print_type(type);
        } else {
            fprintf(stderr, "flotilla-blocks: there is no block %s%s%s\n", argv[i], nearest ? "; the nearest is " : "",
                    nearest ? nearest : "");
            status = 2;
        }
    }
    registry_clear(&registry);
    return status;
}
