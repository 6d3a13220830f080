/* Types of blocks: those of the program, and those of plug-ins. */
#ifndef FLOTILLA_REGISTRY_H
#define FLOTILLA_REGISTRY_H

#include <flotilla/block.h>
#include <stdio.h>

struct registry {
    const struct fl_block_type **types; /* by name */
    size_t count;
};

/* The program's own blocks, then each *.so of `directory` (NULL: none; need not exist). Faulty types and plug-ins are
 * told to `out` and left out; their number is returned. */
unsigned registry_fill(struct registry *registry, const char *directory, FILE *out);

const struct fl_block_type *registry_find(const struct registry *registry, const char *name);

/* The name most like `name`, for a message. NULL: none is. */
const char *registry_nearest(const struct registry *registry, const char *name);

void registry_clear(struct registry *registry);

#endif
