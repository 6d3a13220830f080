/* Hands a new parameter value to the control thread. There is room for one value, and neither side waits.
 *
 * Another thread offers a value. The control thread takes it between two steps, unless the other thread withdraws it
 * first. A step sees either the old value or the new one, and the other thread learns from which step on the new one
 * counts.
 */
#ifndef FLOTILLA_CHANGE_H
#define FLOTILLA_CHANGE_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { CHANGE_BYTES = 8 }; /* of the largest parameter that may be set */

struct change {
    _Alignas(64) _Atomic int state; /* enum in change.c */
    int taken_fd;                   /* readable once the value was taken */
    void *place;
    size_t size;
    unsigned char value[CHANGE_BYTES];
    uint64_t step;
};

/* -1 with errno where no file descriptor is left. */
int change_initialize(struct change *change);
void change_clear(struct change *change);

/* Offer `size` bytes for `place`. The previous value must have been taken or withdrawn. */
void change_offer(struct change *change, void *place, const void *value, size_t size);

/* False: the control thread is already taking it. */
bool change_withdraw(struct change *change);

/* Whether the value was taken; call it once, when `taken_fd` is readable. `step` is the first step with the new value.
 */
bool change_taken(struct change *change, uint64_t *step);

void change_take_offered(struct change *change, uint64_t step);

/* For the control thread, between two steps: take the offered value, if there is one. `step` is the number of the next
 * step. */
static inline void change_take(struct change *change, uint64_t step)
{
    if (atomic_load_explicit(&change->state, memory_order_relaxed))
        change_take_offered(change, step);
}

#endif
