/* Blocks inside a block: what a model calls whose code Embedded Coder made of blocks that
 * `flotilla-blocks --legacy-code` gave to Simulink (docs/apps.md).
 *
 * The block with the model, the outer one, brackets what it calls of the model:
 *   start        fl_inner_begin(block), the model's initialize function, then fl_inner_result(block);
 *                where that fails fl_inner_safe(block), which flotilla-run --safe leaves to it
 *   step         the model's step functions, then fl_inner_result(block)
 *   safe         fl_inner_safe(block)
 *   terminate    the model's terminate function, then fl_inner_end(block)
 * Memory, priority and failures of an inner block are the outer one's. After a failure no step does anything; but what
 * starts later starts, so that actuators can be reset whatever else is broken.
 */
#ifndef FLOTILLA_INNER_H
#define FLOTILLA_INNER_H

#include <flotilla/block.h>

struct fl_inner;

/* Inner blocks that are made from now on belong to `outer`. */
void fl_inner_begin(struct fl_block *outer);

/* FL_OK until an inner block of `outer` has failed. */
int fl_inner_result(const struct fl_block *outer);

/* All inner actuators go to their reset state. */
void fl_inner_safe(const struct fl_block *outer);

/* Terminate the inner blocks that the model has not: coders may leave out its terminate function. */
void fl_inner_end(const struct fl_block *outer);

/* A block of a type; 0 seconds: it runs as often as the outer one. NULL only without memory; the others allow that. */
struct fl_inner *fl_inner_new(const char *type, double period_s);

/* A parameter, before fl_inner_start: as task files have it, lists as [1, 2]; the text need not end with a zero. */
void fl_inner_text(struct fl_inner *inner, const char *parameter, const void *text, size_t length);

/* A parameter that is a number, a truth value or a list of numbers. */
void fl_inner_numbers(struct fl_inner *inner, const char *parameter, const double *values, size_t count);

/* The same; with `fl_inner_tune` it can change in each step. */
void fl_inner_tunable(struct fl_inner *inner, const char *parameter, double value);

/* Configure, start and initialize it. `ports` are those that the caller was made for, as fl_inner_ports writes them. */
void fl_inner_start(struct fl_inner *inner, const char *ports);

/* The values of what fl_inner_tunable named, in that order; in real time. */
void fl_inner_tune(struct fl_inner *inner, const double *values);

/* One step: inputs are read and outputs written where these point, in the order of the block's ports. */
void fl_inner_step(struct fl_inner *inner, const void *const *in, void *const *out);

void fl_inner_terminate(struct fl_inner *inner);

/* Types and widths of a configured block's ports: "double[1] boolean[20] > double[1]". */
void fl_inner_ports(const struct fl_block *block, char *ports, size_t size);

#endif
