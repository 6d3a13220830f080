/* A task file as read from YAML, with line numbers, before it is compared with the known blocks.
 *
 *     period: 10 ms            # ns, us, ms, s
 *     phase: 500 us            # steps are due this long after each multiple of the period; see task_file.c
 *     trigger: gyro            # a step is due when this block has new input; period is then the expected interval
 *     priority: 80             # SCHED_FIFO, 2 to 98; 0: ordinary scheduling
 *     cpu: 1                   # the processor that all threads of the task run on
 *     overrun: skip            # after a step that ends when the next one was already due: skip, catch-up, stop-safe
 *     overruns: 10             # so many overruns in a row lead to the safe state; 0: never
 *     restart: wait            # actuators after a start of the service: wait until a command was off, or resume
 *     blocks:
 *       gyro:
 *         type: dsp3000
 *         every: 1             # runs in every Nth step of the task ...
 *         offset: 0            # ... beginning with this one
 *         in: {in: other.out}  # "block.port", one element of it "block.port[2]", or constants
 *         parameters: {device: /dev/robot/gyro}
 */
#ifndef FLOTILLA_TASK_FILE_H
#define FLOTILLA_TASK_FILE_H

#include "parameter.h"
#include "problem.h"

#include <stdint.h>
#include <stdio.h>
#include <yaml.h>

#define TASK_ANY_CPU (-1)

enum overrun { OVERRUN_SKIP, OVERRUN_CATCH_UP, OVERRUN_STOP_SAFE }; /* the order of the key's choices */
enum restart { RESTART_WAIT, RESTART_RESUME };                      /* likewise */

struct block_entry {
    const char *name, *type;
    unsigned line;
    int64_t every, offset;
    struct raw_value *inputs, *parameters, *bounds; /* an input's strings name its sources */
    size_t input_count, parameter_count, bound_count;
};

struct task_file {
    int64_t period_ns, phase_ns, priority, overruns, cpu; /* `cpu`: TASK_ANY_CPU without the key */
    enum overrun overrun;
    enum restart restart;
    const char *trigger; /* NULL: the clock */
    unsigned trigger_line;
    struct block_entry *blocks; /* in the order of the file */
    size_t count;
    yaml_document_t document; /* owns the strings */
};

/* Read `problems->file`; what is wrong with it goes to `problems`. Free it in any case. */
void task_file_read(struct task_file *task, struct problems *problems);
void task_file_free(struct task_file *task);

/* Write the keys that a file may have as JSON: a list of objects with `key`, dotted from the file's top, `value`
 * (time, integer, choice, name, mapping), `meaning`, and those that apply of `min`, `max`, `choices` (separated by
 * '|'), `default`, and `otherwise`, which is what holds without the key where that is no value. A key with neither of
 * the latter two is required. */
void task_file_write_keys(FILE *out);

#endif
