#include <flotilla/failover.h>
#include <math.h>

void fl_failover_begin(struct fl_failover *failover, int64_t now_ns)
{
    for (size_t rank = 0; rank < FL_SENDERS; rank++)
        failover->received_ns[rank] = now_ns;
}

bool fl_failover_takes(struct fl_failover *failover, size_t rank, int64_t arrived_ns, double timeout)
{
    failover->received_ns[rank] = arrived_ns;
    for (size_t before = 0; timeout > 0 && before < rank; before++)
        if (arrived_ns - failover->received_ns[before] <= llround(timeout * 1e9))
            return false;
    return true;
}
