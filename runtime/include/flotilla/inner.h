/* Blocks inside a block, for models that Embedded Coder translated and that contain blocks which
 * `flotilla-blocks --legacy-code` gave to Simulink (docs/how-to/apps.md).
 *
 * The outer block, which has the model, calls:
 *   start        fl_inner_begin(block), the model's initialize function, then fl_inner_result(block);
 *                on failure also fl_inner_safe(block): flotilla-run --safe calls no `safe` after a start that failed
 *   step         the model's step functions, then fl_inner_result(block)
 *   safe         fl_inner_safe(block)
 *   terminate    the model's terminate function, then fl_inner_end(block)
 * Memory, priority and failures of an inner block belong to the outer one. After a failure no step does anything.
 * Blocks that start later still start, so that actuators can be reset whatever else failed.
 */
#ifndef FLOTILLA_INNER_H
#define FLOTILLA_INNER_H

#include <flotilla/block.h>

struct fl_inner;

/* Inner blocks made from now on belong to `outer`. */
void fl_inner_begin(struct fl_block *outer);

/* FL_OK until an inner block of `outer` has failed. */
int fl_inner_result(const struct fl_block *outer);

/* Bring all inner actuators to their reset state. */
void fl_inner_safe(const struct fl_block *outer);

/* Terminate the inner blocks that the model did not: the generated code may lack a terminate function. */
void fl_inner_end(const struct fl_block *outer);

/* Create a block of a type; 0 seconds: it runs as often as the outer one. NULL only without memory, which the other
 * functions accept. */
struct fl_inner *fl_inner_new(const char *type, double period_s);

/* Set a parameter, before fl_inner_start: as task files have it, lists as [1, 2]. The text need not end with a zero. */
void fl_inner_parameter(struct fl_inner *inner, const char *parameter, const void *text, size_t length);

/* Set a parameter that is a number, a boolean or a list of numbers. */
void fl_inner_numbers(struct fl_inner *inner, const char *parameter, const double *values, size_t count);

/* The same for a parameter that fl_inner_tune can change in each step. */
void fl_inner_tunable(struct fl_inner *inner, const char *parameter, double value);

/* Configure, start and initialize the block. `ports` are those that the caller was generated for, as fl_inner_ports
 * writes them. */
void fl_inner_start(struct fl_inner *inner, const char *ports);

/* Set the parameters that fl_inner_tunable named, in that order; in real time. */
void fl_inner_tune(struct fl_inner *inner, const double *values);

/* One step: inputs are read and outputs written where these point, in the order of the block's ports. */
void fl_inner_step(struct fl_inner *inner, const void *const *in, void *const *out);

void fl_inner_terminate(struct fl_inner *inner);

/* Types and widths of a configured block's ports: "double[1] boolean[20] > double[1]". */
void fl_inner_ports(const struct fl_block *block, char *ports, size_t size);

#endif
