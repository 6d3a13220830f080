#include "change.h"

#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

enum { NONE, OFFERED, TAKING, TAKEN };

int change_initialize(struct change *change)
{
    *change = (struct change){.taken_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)};
    return change->taken_fd < 0 ? -1 : 0;
}

void change_clear(struct change *change)
{
    close(change->taken_fd);
}

void change_offer(struct change *change, void *place, const void *value, size_t size)
{
    change->place = place;
    change->size = size;
    memcpy(change->value, value, size);
    atomic_store_explicit(&change->state, OFFERED, memory_order_release);
}

bool change_withdraw(struct change *change)
{
    int offered = OFFERED;
    return atomic_compare_exchange_strong(&change->state, &offered, NONE);
}

bool change_taken(struct change *change, uint64_t *step)
{
    eventfd_t count;
    eventfd_read(change->taken_fd, &count); /* before the state, which is set before it */
    if (atomic_load_explicit(&change->state, memory_order_acquire) != TAKEN)
        return false;
    *step = change->step;
    atomic_store_explicit(&change->state, NONE, memory_order_relaxed);
    return true;
}

void change_take_offered(struct change *change, uint64_t step)
{
    int offered = OFFERED;
    if (!atomic_compare_exchange_strong_explicit(&change->state, &offered, TAKING, memory_order_acquire,
                                                 memory_order_relaxed))
        return;
    memcpy(change->place, change->value, change->size);
    change->step = step;
    atomic_store_explicit(&change->state, TAKEN, memory_order_release);
    eventfd_write(change->taken_fd, 1); /* never full, so it does not wait */
}
