/* What real time needs of the system. What is refused is said on stderr with its consequence; the task runs all the
 * same, as it must on a development computer. */
#ifndef FLOTILLA_PRIVILEGE_H
#define FLOTILLA_PRIVILEGE_H

/* Keep all memory, present and future, in RAM: so libraries' threads have stacks of 256 kB from now on, not of 8 MB. */
void privilege_lock_memory(void);

/* `priority` where SCHED_FIFO is allowed, otherwise 0 after saying the consequence. */
int privilege_priority(int priority, const char *consequence);

#endif
