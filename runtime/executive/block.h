/* Instances of blocks, as the executive and the tests make them. */
#ifndef FLOTILLA_EXECUTIVE_BLOCK_H
#define FLOTILLA_EXECUTIVE_BLOCK_H

#include "service.h"

#include <flotilla/block.h>

/* With the ports of the type's tables; parameters and state are zero. Not there yet: signals. */
struct fl_block *block_create(const struct fl_block_type *type, const char *name);

/* Storage of all outputs, and zeros for inputs, once `configure` has added its ports. */
int block_make_signals(struct fl_block *block);

/* Let an input read what `signal` points at. */
void block_wire(struct fl_block *block, uint32_t port, const void *signal);

/* Free it and all it allocated; after terminate. */
void block_destroy(struct fl_block *block);

#endif
