/* Values of a task file into the structure that a block's parameters describe. */
#ifndef FLOTILLA_PARAMETER_H
#define FLOTILLA_PARAMETER_H

#include "problem.h"

#include <flotilla/block.h>

/* A value as the task file has it: one string, or a list of them. */
struct raw_value {
    const char *name;
    unsigned line;
    bool list;
    size_t count;
    const char **text;
};

/* Set one parameter of `block` in the structure `parameters`. On failure `reason` says what is expected. Lists and
 * strings are copied into memory of the block. */
bool parameter_set(struct fl_block *block, const struct fl_parameter *parameter, void *parameters,
                   const struct raw_value *value, char *reason, size_t reason_size);

/* The parameter of that name; NULL, with the known names in `reason`. */
const struct fl_parameter *parameter_find(const struct fl_block_type *type, const char *name, char *reason,
                                          size_t reason_size);

/* Write its value as a task file has it. */
void parameter_write(const struct fl_parameter *parameter, const void *parameters, FILE *out);

/* Bytes of a value of that kind in a structure of parameters. */
size_t parameter_size(enum fl_kind kind);

/* Set all parameters: those in `raw`, and the defaults of the others. */
void parameters_set(struct fl_block *block, const struct raw_value *raw, size_t count, unsigned line,
                    struct problems *problems);

/* Keep the bounds in `raw`, a list of the least and the greatest value for each, that parameters have while the task
 * runs. */
void parameters_bound(struct fl_block *block, const struct raw_value *raw, size_t count, struct problems *problems);

/* The value of a parameter as a number; its kind is boolean, an integer or double. */
double parameter_number(enum fl_kind kind, const void *place);

/* Numbers as task files write them: decimal or 0x…, with an optional unit of time for times. */
bool read_integer(const char *text, int64_t *value);
bool read_unsigned(const char *text, uint64_t *value);
bool read_double(const char *text, double *value);

/* The index of `name` among choices that '|' separates; -1: it is none of them. */
int parameter_choice(const char *choices, const char *name);

/* "10 ms", "1 s", "500 us": nanoseconds. */
bool read_duration(const char *text, int64_t *value_ns);

#endif
