/* Copies signals of a running task: the control thread puts a row after a step, another thread takes it and writes it.
 */
#ifndef FLOTILLA_SAMPLER_H
#define FLOTILLA_SAMPLER_H

#include "run.h"

#include <stdio.h>

struct sampler;
struct row; /* the signals after one step */

/* Bytes of a row of these signals; a sampler has memory for a thousand. */
size_t sampler_row_bytes(const struct watched *watched, size_t count);

/* The table stays the caller's and must last as long as the sampler. */
struct sampler *sampler_create(const struct watched *watched, size_t count);
void sampler_destroy(struct sampler *sampler); /* NULL is allowed */

/* Copy the present values. With `wait`: wait until there is room (not in real time); otherwise drop them, and count
 * that, when there is none. */
void sampler_put(struct sampler *sampler, uint64_t step, int64_t release_ns, bool wait);

/* The next row, valid until the next call; NULL: there is none. */
const struct row *sampler_take(struct sampler *sampler);

/* The first element of a signal in a row; `which` is its place in the table. */
double sampler_number(const struct sampler *sampler, const struct row *row, size_t which);

/* A row as a line of JSON: {"step": 0, "release_ns": 0, "lost": 0, "block.port": 1.5}. `lost`: rows dropped before. */
void sampler_write(const struct sampler *sampler, const struct row *row, FILE *out);

/* The same as CSV (RFC 4180, lines end with a line feed); each element of a signal has a column. What is not finite is
 * an empty cell. */
void sampler_write_csv_head(const struct sampler *sampler, FILE *out);
void sampler_write_csv(const struct sampler *sampler, const struct row *row, FILE *out);

#endif
