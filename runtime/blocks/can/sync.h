/* Decides which block sends SYNC on a bus: one block of this computer at a time, in any task.
 *
 * The claim (core/claim.h) is named after the interface and, like this, is local to the network namespace.
 */
#ifndef FLOTILLA_CAN_SYNC_H
#define FLOTILLA_CAN_SYNC_H

#include <stdatomic.h>
#include <stdbool.h>

struct can_sync {
    int fd;            /* holds the claim, or ends with its holder */
    unsigned deaf;     /* times in a row that the holder did not listen */
    _Atomic bool mine; /* this block has it */
};

/* Claim the SYNC of `interface` unless this block has it already; another block may have it. Not in a step. */
void can_sync_claim(struct can_sync *sync, const char *interface);

/* Release the claim for the next block. */
void can_sync_release(struct can_sync *sync);

#endif
