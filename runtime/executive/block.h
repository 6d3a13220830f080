/* Instances of blocks, for the executive and the tests. */
#ifndef FLOTILLA_EXECUTIVE_BLOCK_H
#define FLOTILLA_EXECUTIVE_BLOCK_H

#include "core/service.h"

#include <flotilla/block.h>

#if defined(__SANITIZE_ADDRESS__)
#define BLOCK_ALONE 1
#elif defined(__has_feature)
#define BLOCK_ALONE __has_feature(address_sanitizer)
#else
#define BLOCK_ALONE 0
#endif

enum {
    BLOCK_NEAR = BLOCK_ALONE ? 0 : 2 * FL_CACHE_LINE, /* beside a block, for its small pieces; AddressSanitizer only
                                                       * sees a write beyond a piece that lies alone */
    BLOCK_TOUCHED = 3 * FL_CACHE_LINE,                /* the block, and most often all of its pieces */
};

/* Create a block with the ports of its type; parameters and state are zero, signals are not made yet. */
struct fl_block *block_create(const struct fl_block_type *type, const char *name);

/* Allocate all outputs, and zeros for inputs without a wire, after `configure` has added its ports. */
int block_make_signals(struct fl_block *block);

/* Wire an input to `signal`. */
void block_wire(struct fl_block *block, uint32_t port, const void *signal);

/* Begin a step that was due at `release_ns`. */
static inline void block_release(struct fl_block *block, int64_t release_ns)
{
    const int64_t longest_ns = FL_LONGEST_INTERVAL * block->period_ns;
    int64_t interval_ns = block->step ? release_ns - block->release_ns : block->period_ns;
    interval_ns = interval_ns < longest_ns ? interval_ns : longest_ns;
    block->interval_ns = interval_ns > 0 ? interval_ns : 0;
    block->release_ns = release_ns;
}

/* Prefetch the memory that a step touches. NULL is allowed. */
static inline void block_prefetch(const struct fl_block *block)
{
    for (size_t at = 0; at < BLOCK_TOUCHED; at += FL_CACHE_LINE)
        __builtin_prefetch((const char *)block + at);
}

/* Free the block and all that it allocated, inner blocks too; after terminate. */
void block_destroy(struct fl_block *block);

#endif
