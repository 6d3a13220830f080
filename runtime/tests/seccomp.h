/* Steps may not block: run them where the kernel ends a process that makes a call which might. */
#ifndef FLOTILLA_SECCOMP_H
#define FLOTILLA_SECCOMP_H

#include <flotilla/block.h>

/* Run `run(context)` in a forked child whose system calls are limited to those a step may make: reading clocks, sending
 * and receiving with MSG_DONTWAIT, POSIX message queues, waking another thread. What it changes is lost with the child.
 * 0: it made no other and ended; -1: it did not end within two seconds, so one of these waited (a queue without
 * O_NONBLOCK, say); otherwise the number of the first system call that is not among them (sys/syscall.h). */
int forbidden_call(void (*run)(void *context), void *context);

/* The test fails unless `block`, begun, takes `steps` steps so, each with success. */
void steps_under_seccomp(struct fl_block *block, unsigned steps);

#endif
