#include "schedule.h"

#include "block.h"
#include "safety.h"
#include "ticks.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { AHEAD = 4 }; /* blocks: a line comes from memory in the time that those take */

/* A block's step and its duration in ticks. The block counts its steps. */
struct call {
    int (*step)(struct fl_block *block);
    struct fl_block *block;
    int64_t sum, max;
};

/* Calls that follow each other and have the same turns: most often all of a task. */
struct turn {
    uint32_t count, every;
    uint32_t until; /* steps of the task until its next */
};

struct schedule {
    struct call *calls;
    struct turn *turns;
    size_t count, turn_count;
    const struct latch *latches; /* the task's */
    size_t latch_count;
    bool counter;
    struct moment begin;
};

static void *made(size_t bytes)
{
    void *memory = calloc(1, bytes);
    if (!memory)
        abort();
    return memory;
}

struct schedule *schedule_create(const struct task *task)
{
    struct schedule *schedule = made(sizeof *schedule);
    schedule->calls = made(sizeof *schedule->calls * (task->count + AHEAD));
    schedule->turns = made(sizeof *schedule->turns * (task->count + 1));
    schedule->count = task->count;
    schedule->latches = task->latches;
    schedule->latch_count = task->latch_count;
    for (size_t i = 0; i < task->count; i++) {
        const struct task_block *task_block = &task->blocks[i];
        schedule->calls[i] = (struct call){.step = task_block->block->type->step, .block = task_block->block};
        if (!i || task_block->every != task_block[-1].every || task_block->offset != task_block[-1].offset)
            schedule->turns[schedule->turn_count++] =
                (struct turn){.every = (uint32_t)task_block->every, .until = (uint32_t)task_block->offset};
        schedule->turns[schedule->turn_count - 1].count++;
    }
    schedule->counter = ticks_constant();
    schedule->begin = ticks_moment(schedule->counter);
    return schedule;
}

void schedule_destroy(struct schedule *schedule)
{
    if (!schedule)
        return;
    free(schedule->calls);
    free(schedule->turns);
    free(schedule);
}

/* The end of a block's step is the begin of the next one's. */
const struct fl_block *schedule_step(struct schedule *schedule, int64_t release_ns)
{
    const bool counter = schedule->counter;
    struct call *call = schedule->calls;
    for (size_t i = 0; i < schedule->latch_count; i++)
        memcpy(schedule->latches[i].kept, schedule->latches[i].signal, schedule->latches[i].bytes);
    int64_t before = ticks_now(counter);
    for (struct turn *turn = schedule->turns, *last = turn + schedule->turn_count; turn < last; turn++) {
        struct call *end = call + turn->count;
        if (turn->until) {
            turn->until--;
            call = end;
            continue;
        }
        turn->until = turn->every - 1;
        for (; call < end; call++) {
            struct fl_block *block = call->block;
            block_prefetch(call[AHEAD].block);
            block_release(block, release_ns);
            safety_running = block;
            int failed = call->step(block);
            block->step++;
            int64_t after = ticks_now(counter), took = after - before;
            before = after;
            call->sum += took;
            if (took > call->max)
                call->max = took;
            if (failed)
                return block;
        }
    }
    return NULL;
}

void schedule_report(const struct schedule *schedule, struct task *task)
{
    double unit_ns = ticks_ns(schedule->begin, ticks_moment(schedule->counter));
    for (size_t i = 0; i < schedule->count; i++) {
        const struct call *call = &schedule->calls[i];
        uint64_t count = call->block->step;
        task->blocks[i].timing = (struct timing){
            .count = count,
            .mean_ns = llround(count ? unit_ns * (double)call->sum / (double)count : 0),
            .max_ns = llround(unit_ns * (double)call->max),
        };
    }
}
