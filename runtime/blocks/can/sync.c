#include "sync.h"

#include "core/claim.h"

#include <poll.h>
#include <unistd.h>

enum { DEAF = 8 }; /* times that a holder may be found to be none that listens */

void can_sync_claim(struct can_sync *sync, const char *interface)
{
    struct claim claim;
    if (atomic_load(&sync->mine) || (sync->fd > 0 && poll(&(struct pollfd){.fd = sync->fd}, 1, 0) == 0))
        return;
    if (sync->fd > 0)
        close(sync->fd);
    enum claim_result result = claim_take("flotilla-can-sync", interface, sync->deaf >= DEAF, &claim);
    sync->deaf = result == CLAIM_DEAF ? sync->deaf + 1 : 0;
    sync->fd = claim.fd > 0 ? claim.fd : 0;
    atomic_store(&sync->mine, result == CLAIM_OURS);
}

void can_sync_release(struct can_sync *sync)
{
    atomic_store(&sync->mine, false);
    if (sync->fd > 0)
        close(sync->fd);
    sync->fd = 0;
    sync->deaf = 0;
}
