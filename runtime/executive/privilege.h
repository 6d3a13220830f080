/* Privileges for real time. Where one is refused, the consequence is reported on stderr and the task runs without it,
 * as on a development computer. */
#ifndef FLOTILLA_PRIVILEGE_H
#define FLOTILLA_PRIVILEGE_H

/* Lock all memory, present and future, in RAM; what is there now alone, where the limit of a user is too low for
 * threads. Stacks then count in full, so threads started from now on, by libraries
 * too, get 256 kB of stack instead of 8 MB unless they ask for a size. */
void privilege_lock_memory(void);

/* Returns `priority` where SCHED_FIFO is allowed, otherwise 0 after reporting the consequence. */
int privilege_priority(int priority, const char *consequence);

/* Let the calling thread, and all that it starts, run on one processor alone; 0 or an errno. */
int privilege_processor(int cpu);

/* Touch the stack of the calling thread, as deep as a step may use it. */
void privilege_touch_stack(void);

#endif
