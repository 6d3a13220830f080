/* The program's side of inner blocks. */
#ifndef FLOTILLA_EXECUTIVE_INNER_H
#define FLOTILLA_EXECUTIVE_INNER_H

#include <flotilla/inner.h>

/* With its parameters and ports, not started; NULL after the outer block was told why. */
struct fl_block *inner_configure(struct fl_inner *inner);

/* The least that `of` says of the inner blocks of one; INT64_MAX: it has none. */
int64_t inner_shortest(const struct fl_block *outer, int64_t (*of)(const struct fl_block *block));

/* Free the inner blocks of one. */
void inner_destroy(const struct fl_block *outer);

#endif
