/* A parameter's new value on its way to the control thread: room for one, which neither side waits for.
 *
 * Another thread offers a value; the control thread takes it between two steps, or the other one withdraws it. So a
 * step sees the old value or the new one, and whoever offers knows which, from which step on.
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
    int taken_fd;                   /* becomes readable when it was taken */
    void *place;
    size_t size;
    unsigned char value[CHANGE_BYTES];
    uint64_t step;
};

/* -1 with errno where the system has no descriptor left. */
int change_initialize(struct change *change);
void change_clear(struct change *change);

/* Offer `size` bytes for `place`. Only after the one before was taken or withdrawn. */
void change_offer(struct change *change, void *place, const void *value, size_t size);

/* False: too late, it is being taken. */
bool change_withdraw(struct change *change);

/* Whether it was taken, once `taken_fd` is readable, and no more after this call; `step` is the first one that has it.
 */
bool change_taken(struct change *change, uint64_t *step);

void change_take_offered(struct change *change, uint64_t step);

/* For the control thread, between two steps: take what is offered, if anything is. `step` is the next one's number. */
static inline void change_take(struct change *change, uint64_t step)
{
    if (atomic_load_explicit(&change->state, memory_order_relaxed))
        change_take_offered(change, step);
}

#endif
