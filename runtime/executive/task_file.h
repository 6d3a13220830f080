/* A task file as it is written: what YAML says, with lines, not yet compared with the blocks that exist.
 *
 *     period: 10 ms            # ns, us, ms, s
 *     phase: 500 us            # steps are due this long after each multiple of the period; see task_file.c
 *     trigger: gyro            # steps are due when this block has something new; the period is how often that is
 *     priority: 80             # SCHED_FIFO, 2 to 98; 0: ordinary scheduling
 *     overrun: skip            # what follows a step that ends after the next one was due: skip, catch-up, stop-safe
 *     overruns: 10             # that many in a row lead to the safe state; 0: never
 *     blocks:
 *       gyro:
 *         type: dsp3000
 *         every: 1             # runs in each n-th step of the task ...
 *         offset: 0            # ... beginning with this one
 *         in: {in: other.out}  # "block.port", one element of it "block.port[2]", or constants
 *         parameters: {device: /dev/robot/gyro}
 */
#ifndef FLOTILLA_TASK_FILE_H
#define FLOTILLA_TASK_FILE_H

#include "parameter.h"
#include "problem.h"

#include <stdint.h>
#include <yaml.h>

enum overrun { OVERRUN_SKIP, OVERRUN_CATCH_UP, OVERRUN_STOP_SAFE };

struct block_entry {
    const char *name, *type;
    unsigned line;
    int64_t every, offset;
    struct written *inputs, *parameters; /* an input's texts are its sources */
    size_t input_count, parameter_count;
};

struct task_file {
    int64_t period_ns, phase_ns, priority, overruns;
    enum overrun overrun;
    const char *trigger; /* NULL: the clock */
    unsigned trigger_line;
    struct block_entry *blocks; /* in the order of the file */
    size_t count;
    yaml_document_t document; /* owns the texts */
};

/* Read `problems->file`; what is wrong with it goes to `problems`. Free it in any case. */
void task_file_read(struct task_file *task, struct problems *problems);
void task_file_free(struct task_file *task);

#endif
