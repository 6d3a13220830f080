/* Who sends SYNC on a bus: one of the blocks of this computer at a time, in whatever tasks they are.
 *
 * The claim is an abstract Unix address named after the interface, which one socket can have. Like the interface it is
 * of the network namespace, and the kernel frees it when its process ends, however it ends. */
#ifndef FLOTILLA_CAN_SYNC_H
#define FLOTILLA_CAN_SYNC_H

#include <stdatomic.h>
#include <stdbool.h>

struct can_sync {
    int fd;
    _Atomic bool mine;
};

/* Claim the SYNC of `interface` unless it is mine already; another block may have it. Not in a step. */
void can_sync_claim(struct can_sync *sync, const char *interface);

/* Give it to whoever claims it next. */
void can_sync_release(struct can_sync *sync);

#endif
