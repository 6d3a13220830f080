/* Types of blocks: those of the program, and those of plug-ins. */
#ifndef FLOTILLA_REGISTRY_H
#define FLOTILLA_REGISTRY_H

#include <flotilla/block.h>
#include <stdio.h>

struct registry {
    const struct fl_block_type **types; /* by name */
    size_t count;
    const char
        *plugins; /* directories, separated by ':', of *.so that wait until a block is wanted which is not there */
    FILE *out;    /* what is wrong with types and plug-ins */
};

/* The program's own blocks. `plugins` may be NULL, and a directory of it may not exist; it must live as long as the
 * registry. Number of faulty types, which are left out. */
unsigned registry_fill(struct registry *registry, const char *plugins, FILE *out);

/* Load the plug-ins that are not loaded yet. Number of those, and of their types, that were faulty and left out. */
unsigned registry_load_plugins(struct registry *registry);

/* NULL: neither the program nor a plug-in has it. */
const struct fl_block_type *registry_find(struct registry *registry, const char *name);

/* The name most like `name`, for a message. NULL: none is. */
const char *registry_nearest(const struct registry *registry, const char *name);

void registry_clear(struct registry *registry);

#endif
