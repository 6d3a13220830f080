/* The program's side of inner blocks. */
#ifndef FLOTILLA_EXECUTIVE_INNER_H
#define FLOTILLA_EXECUTIVE_INNER_H

#include <flotilla/inner.h>

/* With its parameters and ports, not started; NULL after the outer block was told why. */
struct fl_block *inner_configure(struct fl_inner *inner);

/* Free the inner blocks of one. */
void inner_destroy(const struct fl_block *outer);

#endif
