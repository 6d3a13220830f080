/* Values of a task file into the structure that a block's parameters describe. */
#ifndef FLOTILLA_PARAMETER_H
#define FLOTILLA_PARAMETER_H

#include "problem.h"

#include <flotilla/block.h>

/* A value as it was written: one text, or a list of them. */
struct written {
    const char *name;
    unsigned line;
    bool list;
    size_t count;
    const char **text;
};

/* Set one parameter of `block` at `parameters`. On failure `reason` says what would be right. Lists and texts are kept
 * in memory of the block. */
bool parameter_set(struct fl_block *block, const struct fl_parameter *parameter, void *parameters,
                   const struct written *value, char *reason, size_t reason_size);

/* The parameter of that name; NULL with what there is in `reason`. */
const struct fl_parameter *parameter_find(const struct fl_block_type *type, const char *name, char *reason,
                                          size_t reason_size);

/* Its value in the structure `parameters`, as a task file writes it. */
void parameter_write(const struct fl_parameter *parameter, const void *parameters, FILE *out);

/* Bytes of a value of that kind in a structure of parameters. */
size_t parameter_size(enum fl_kind kind);

/* All of them: what is written, and the fallbacks of what is not. */
void parameters_set(struct fl_block *block, const struct written *written, size_t count, unsigned line,
                    struct problems *problems);

/* Numbers as task files write them: decimal or 0x…, with an optional unit of time for times. */
bool read_integer(const char *text, int64_t *value);
bool read_unsigned(const char *text, uint64_t *value);
bool read_real(const char *text, double *value);

/* "10 ms", "1 s", "500 us": nanoseconds. */
bool read_duration(const char *text, int64_t *value_ns);

#endif
