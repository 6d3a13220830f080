/* A task: blocks, wired and in the order in which a step runs them. */
#ifndef FLOTILLA_TASK_H
#define FLOTILLA_TASK_H

#include "registry.h"
#include "task_file.h"

struct timing {
    uint64_t count; /* of steps */
    int64_t mean_ns, max_ns;
};

struct task_block {
    struct fl_block *block;
    int64_t every, offset;
    struct timing timing; /* of its steps, after a run */
    bool started, failed; /* `failed`: its start */
    bool wrong;           /* its parameters */
    bool incomplete;      /* its ports are not known, because its parameters are wrong */
};

/* What a block with a delayed input reads, where it runs after the source of that input: the source's value of the step
 * before, copied when a step begins. */
struct latch {
    void *kept;
    const void *signal;
    size_t bytes;
};

struct task {
    char *name; /* the file's, without directory and suffix */
    int64_t period_ns, phase_ns, overruns;
    enum restart restart;
    int priority;
    int cpu; /* TASK_ANY_CPU, or the processor of all threads */
    enum overrun overrun;
    struct fl_block *trigger;  /* a step is due when this block has new input */
    struct task_block *blocks; /* in the order of execution */
    size_t count;
    struct latch *latches;
    size_t latch_count;
};

/* Build the task of `problems->file`. All problems go to `problems`; without any the task is usable. Opens no device.
 */
void task_build(struct task *task, struct registry *registry, struct problems *problems);
void task_free(struct task *task);

/* "block.port" or "block.port[2]" of `task`: the signal, its type and its width; NULL with the reason in `reason`. */
const void *task_signal(const struct task *task, const char *name, enum fl_type *type, uint32_t *width, char *reason,
                        size_t reason_size);

/* The shortest time-out of an actuator (FL_ACTUATOR_TIMEOUT), of inner blocks too once they have started, in
 * nanoseconds; INT64_MAX: there is none. */
int64_t task_actuator_timeout(const struct task *task);

/* The task as a graph for Graphviz. */
void task_write_dot(const struct task *task, FILE *out);

#endif
