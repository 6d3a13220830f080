/* Hot standby: several senders of one signal, of which a receiver listens to one.
 *
 * Senders have ranks, 0 first. A receiver accepts messages of a sender while all senders of lower rank have been silent
 * for longer than a time-out. So it listens to one sender at a time. The next in rank takes over a time-out after the
 * last message of the one before, and yields with the first message of it. This is exclusive ownership as in DDS (OMG
 * DDS 1.4, 2.2.3.9), for plain datagrams. A sender without valid data must stay silent. With a time-out of 0 all are
 * listened to.
 */
#ifndef FLOTILLA_FAILOVER_H
#define FLOTILLA_FAILOVER_H

#include <flotilla/block.h>

enum { FL_SENDERS = 4 };

struct fl_failover {
    int64_t received_ns[FL_SENDERS];
};

/* The parameter `double failover` of the structure `type`. */
#define FL_FAILOVER(type)                                                                                              \
    FL_PARAMETER(type, failover, .default_value = "0.03", .min = 0, .max = 3600, .unit = "s",                          \
                 .summary =                                                                                            \
                     "with several senders: time-out after which the next in rank takes over; 0: all are listened to")

/* Begin as if all senders had sent at `now_ns`. */
void fl_failover_begin(struct fl_failover *failover, int64_t now_ns);

/* Whether to accept a message of the sender of that rank, which arrived at `arrived_ns`. */
bool fl_failover_takes(struct fl_failover *failover, size_t rank, int64_t arrived_ns, double timeout);

#endif
