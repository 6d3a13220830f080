/* What real time needs of the system. What is refused is said on stderr with its consequence; the task runs all the
 * same, as it must on a development computer. */
#ifndef FLOTILLA_PRIVILEGE_H
#define FLOTILLA_PRIVILEGE_H

/* Keep all memory, present and future, in RAM. Stacks count in full then: threads made from now on, by libraries too,
 * have 256 kB of it instead of 8 MB, unless their maker says otherwise. */
void privilege_lock_memory(void);

/* `priority` where SCHED_FIFO is allowed, otherwise 0 after saying the consequence. */
int privilege_priority(int priority, const char *consequence);

#endif
