/* Blocks as a command line names them: NAME [PARAMETER=VALUE]... */
#ifndef FLOTILLA_NAMED_BLOCK_H
#define FLOTILLA_NAMED_BLOCK_H

#include "executive/registry.h"

#include <flotilla/block.h>

struct named_block {
    const struct fl_block_type *type;
    char *const *words; /* PARAMETER=VALUE */
    int word_count;
    struct fl_block *outer; /* the outer block that has it as an inner block; destroy it */
    const struct fl_block *block;
};

/* Make `blocks` those that the words name; returns how many, at most `count`, or -1 after a message on `registry->out`.
 */
int named_blocks(struct registry *registry, char *const *words, int count, struct named_block *blocks);

/* The VALUE of a parameter; NULL: none is given. */
const char *named_block_value(const struct named_block *named, const struct fl_parameter *parameter);

/* Create the block and determine its ports, which `configure` may add. It gets the given values, defaults, and anything
 * for what else is required. False with the reason. */
bool named_block_configure(struct named_block *named, struct registry *registry, char *reason, size_t reason_size);

#endif
