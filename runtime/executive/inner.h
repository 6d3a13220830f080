/* The program's side of inner blocks. */
#ifndef FLOTILLA_EXECUTIVE_INNER_H
#define FLOTILLA_EXECUTIVE_INNER_H

#include <flotilla/inner.h>

/* The configured block, not started; NULL after a failure was reported to the outer block. */
struct fl_block *inner_configure(struct fl_inner *inner);

/* The least value of `of` among the inner blocks; INT64_MAX: there is no inner block. */
int64_t inner_shortest(const struct fl_block *outer, int64_t (*of)(const struct fl_block *block));

/* How often serial ports of the block, and of those inside it, have lost bytes. From any thread. */
uint32_t inner_lost(const struct fl_block *outer);

/* Whether the block, or one inside it, is an actuator that waits for a command that is off. From any thread. */
bool inner_waits(const struct fl_block *outer);

#endif
