#define _GNU_SOURCE
#include "registry.h"

#include "core/service.h"

#include <dlfcn.h>
#include <glob.h>
#include <stdlib.h>
#include <string.h>

static int by_name(const void *left, const void *right)
{
    const struct fl_block_type *const *a = left, *const *b = right;
    return strcmp((*a)->name, (*b)->name);
}

static const struct fl_block_type *find(const struct registry *registry, const char *name)
{
    const struct fl_block_type wanted = {.name = name}, *key = &wanted;
    if (!registry->count)
        return NULL;
    const struct fl_block_type *const *found =
        bsearch(&key, registry->types, registry->count, sizeof(*registry->types), by_name);
    return found ? *found : NULL;
}

/* What is wrong with a type, or NULL. */
static const char *fault(const struct registry *registry, const struct fl_block_type *type)
{
    if (!type->name || !*type->name)
        return "it has no name";
    if (!type->step)
        return "it has no step";
    if (find(registry, type->name))
        return "another block has that name";
    for (uint32_t i = 0; i < type->parameter_count; i++) {
        const struct fl_parameter *parameter = &type->parameters[i];
        if ((parameter->kind == FL_KIND_CHOICE) != (parameter->choices != NULL))
            return "a parameter of type int has no choices, or another has some";
        if (parameter->flags & FL_ACTUATOR_TIMEOUT && parameter->kind != FL_KIND_DOUBLE)
            return "an actuator's time-out is not a double";
        if (parameter->flags & FL_CAN_INTERFACE && parameter->kind != FL_KIND_STRING)
            return "the name of a CAN interface is not a string";
        if (parameter->offset >= type->parameters_size)
            return "a parameter lies outside its structure";
    }
    for (uint32_t i = 0; i < type->output_count; i++)
        if (!fl_output_possible(&type->outputs[i]))
            return "an output that counts refusals is not one uint32";
    return NULL;
}

static unsigned add(struct registry *registry, const struct fl_block_type *const *types, size_t count,
                    const char *origin)
{
    FILE *out = registry->out;
    unsigned faults = 0;
    for (size_t i = 0; i < count; i++) {
        const struct fl_block_type *type = types[i];
        if (type->abi != FL_ABI) { /* the rest of it cannot be read */
            fprintf(out, "%s%s: built for block interface %u, this runtime has %u; rebuild it\n",
                    fl_priority(FL_WARNING), origin, type->abi, FL_ABI);
            faults++;
            continue;
        }
        const char *wrong = fault(registry, type);
        if (wrong) {
            fprintf(out, "%s%s: block %s: %s\n", fl_priority(FL_WARNING), origin, type->name ? type->name : "?", wrong);
            faults++;
            continue;
        }
        registry->types = realloc(registry->types, sizeof(*registry->types) * (registry->count + 1));
        if (!registry->types)
            abort();
        registry->types[registry->count++] = type;
        qsort(registry->types, registry->count, sizeof(*registry->types), by_name);
    }
    return faults;
}

static unsigned add_plugin(struct registry *registry, const char *path)
{
    FILE *out = registry->out;
    union {
        void *symbol;
        const struct fl_block_type *const *(*blocks)(size_t *count);
    } found;
    void *library = dlopen(path, RTLD_NOW | RTLD_LOCAL);
    size_t count = 0;
    if (!library) {
        fprintf(out, "%s%s\n", fl_priority(FL_WARNING), dlerror());
        return 1;
    }
    found.symbol = dlsym(library, "fl_blocks");
    if (!found.symbol) {
        fprintf(out, "%s%s: defines no block; use FL_BLOCK of flotilla/block.h\n", fl_priority(FL_WARNING), path);
        dlclose(library);
        return 1;
    }
    const struct fl_block_type *const *types = found.blocks(&count);
    return add(registry, types, count, path);
}

unsigned registry_fill(struct registry *registry, const char *plugins, FILE *out)
{
    size_t count;
    const struct fl_block_type *const *types = fl_blocks(&count);
    *registry = (struct registry){.plugins = plugins, .out = out};
    return add(registry, types, count, "flotilla");
}

/* Load the plug-ins of the next directory. */
static unsigned load_next(struct registry *registry)
{
    glob_t found;
    char pattern[4096];
    unsigned faults = 0;
    const char *directory = registry->plugins;
    size_t length = strcspn(directory, ":");
    registry->plugins = directory[length] ? directory + length + 1 : NULL;
    snprintf(pattern, sizeof pattern, "%.*s/*.so", (int)length, directory);
    if (glob(pattern, 0, NULL, &found) == 0) {
        for (size_t i = 0; i < found.gl_pathc; i++)
            faults += add_plugin(registry, found.gl_pathv[i]);
        globfree(&found);
    }
    return faults;
}

unsigned registry_load_plugins(struct registry *registry)
{
    unsigned faults = 0;
    while (registry->plugins)
        faults += load_next(registry);
    return faults;
}

const struct fl_block_type *registry_find(struct registry *registry, const char *name)
{
    const struct fl_block_type *found = find(registry, name);
    while (!found && registry->plugins) {
        load_next(registry);
        found = find(registry, name);
    }
    return found;
}

/* Levenshtein's distance, for short names. */
static size_t distance(const char *left, const char *right)
{
    enum { LONGEST = 64 };
    size_t row[LONGEST + 1], columns = strlen(right), rows = strlen(left);
    if (columns > LONGEST)
        return LONGEST;
    for (size_t j = 0; j <= columns; j++)
        row[j] = j;
    for (size_t i = 1; i <= rows; i++) {
        size_t diagonal = row[0];
        row[0] = i;
        for (size_t j = 1; j <= columns; j++) {
            size_t above = row[j], best = diagonal + (left[i - 1] != right[j - 1]);
            best = above + 1 < best ? above + 1 : best;
            best = row[j - 1] + 1 < best ? row[j - 1] + 1 : best;
            diagonal = above;
            row[j] = best;
        }
    }
    return row[columns];
}

const char *registry_nearest(const struct registry *registry, const char *name)
{
    const char *nearest = NULL;
    size_t least = strlen(name) / 2 + 1;
    for (size_t i = 0; i < registry->count; i++) {
        size_t far = distance(name, registry->types[i]->name);
        if (far < least) {
            least = far;
            nearest = registry->types[i]->name;
        }
    }
    return nearest;
}

void registry_clear(struct registry *registry)
{
    free(registry->types);
    *registry = (struct registry){0};
}
