/* Several senders of one signal, of whom a receiver listens to one: hot standby.
 *
 * Senders have ranks, 0 first. A receiver takes what comes from one of them while all of lesser rank have been silent
 * for longer than a time-out. So there is never more than one at a time; the next in rank takes over a time-out after
 * the last message, and hands back with the first message of one before it. That is exclusive ownership as DDS has it
 * (OMG DDS 1.4, 2.2.3.9), which plain datagrams do not have. A sender that has nothing good to say has to be silent.
 */
#ifndef FLOTILLA_FAILOVER_H
#define FLOTILLA_FAILOVER_H

#include <flotilla/block.h>

enum { FL_SENDERS = 4 };

struct fl_failover {
    int64_t heard_ns[FL_SENDERS];
};

/* The parameter `double failover` of the structure `type`. */
#define FL_FAILOVER(type)                                                                                              \
    FL_PARAMETER(type, failover, .fallback = "0.03", .min = 0.001, .max = 3600, .unit = "s",                           \
                 .summary = "with several senders: one is listened to when those before it are silent for longer")

/* As if all had been heard at `now_ns`. */
void fl_failover_begin(struct fl_failover *failover, int64_t now_ns);

/* A message of the sender of that rank, which came at `arrived_ns`: whether it is to be taken. */
bool fl_failover_takes(struct fl_failover *failover, size_t rank, int64_t arrived_ns, double timeout);

#endif
