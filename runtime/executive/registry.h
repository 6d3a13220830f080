/* The known types of blocks: those of the program, and those of plug-ins. */
#ifndef FLOTILLA_REGISTRY_H
#define FLOTILLA_REGISTRY_H

#include <flotilla/block.h>
#include <stdio.h>

struct registry {
    const struct fl_block_type **types; /* by name */
    size_t count;
    const char
        *plugins; /* directories of plug-ins (*.so), separated by ':', that are loaded once a block is not found */
    FILE *out;    /* for messages about faulty types and plug-ins */
};

/* Fill the registry with the program's own blocks. `plugins` may be NULL, its directories need not exist, and it must
 * live as long as the registry. Returns the number of faulty types, which are left out. */
unsigned registry_fill(struct registry *registry, const char *plugins, FILE *out);

/* Load the remaining plug-ins. Returns the number of faulty plug-ins and types, which are left out. */
unsigned registry_load_plugins(struct registry *registry);

/* The type of that name; NULL where neither the program nor a plug-in has it. */
const struct fl_block_type *registry_find(struct registry *registry, const char *name);

/* The known name most similar to `name`, for a message; NULL: none is similar. */
const char *registry_nearest(const struct registry *registry, const char *name);

void registry_clear(struct registry *registry);

#endif
