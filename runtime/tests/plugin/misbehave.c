/* Plug-in with blocks that do what a block must not, and one that leaves a trace: for the tests of the executive. */
#include <fcntl.h>
#include <flotilla/block.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#ifndef MISBEHAVE_ABI
#define MISBEHAVE_ABI FL_ABI
#endif

struct misbehave {
    int manner;
    int64_t from, until; /* steps in which it misbehaves */
    double late_s;
};

static const struct fl_parameter misbehave_parameters[] = {
    FL_PARAMETER(struct misbehave, manner, .choices = "fail|hang|late|allocate|start-fail"),
    FL_PARAMETER(struct misbehave, from, .fallback = "0"),
    FL_PARAMETER(struct misbehave, until, .fallback = "1000000000"),
    FL_PARAMETER(struct misbehave, late_s, .fallback = "0.025"),
};

static int misbehave_start(struct fl_block *block)
{
    const struct misbehave *parameters = block->parameters;
    return parameters->manner == 4 ? fl_fail(block, "the device is on fire") : FL_OK;
}

static int misbehave_step(struct fl_block *block)
{
    const struct misbehave *parameters = block->parameters;
    if ((int64_t)block->step < parameters->from || (int64_t)block->step >= parameters->until)
        return FL_OK;
    switch (parameters->manner) {
    case 0:
        return fl_fail(block, "failed as asked in step %d", (int)block->step);
    case 1:
        for (;;)
            pause();
    case 2:
        for (int64_t end_ns = fl_now_ns() + (int64_t)(parameters->late_s * 1e9); fl_now_ns() < end_ns;)
            continue;
        return FL_OK;
    default: {
        void *volatile memory = malloc(100);
        free(memory);
        return FL_OK;
    }
    }
}

FL_BLOCK(misbehave) = {
    .abi = MISBEHAVE_ABI,
    .name = "misbehave",
    FL_TABLE(parameter, misbehave_parameters),
    .parameters_size = sizeof(struct misbehave),
    .start = misbehave_start,
    .step = misbehave_step,
};

/* An actuator whose device is a file: "on" by steps, "reset" by safe and terminate. */
struct trace {
    struct fl_device device;
};

static const struct fl_parameter trace_parameters[] = {FL_PARAMETER(struct trace, device)};

static void trace_write(struct fl_block *block, const char *word)
{
    const struct trace *parameters = block->parameters;
    int fd = open(parameters->device.path, O_WRONLY | O_CREAT | O_APPEND, 0600);
    if (fd >= 0 && write(fd, word, strlen(word)) > 0)
        close(fd);
}

static int trace_step(struct fl_block *block)
{
    trace_write(block, "on\n");
    return FL_OK;
}

static void trace_safe(struct fl_block *block)
{
    trace_write(block, "safe\n");
}

static void trace_terminate(struct fl_block *block)
{
    trace_write(block, "terminated\n");
}

FL_BLOCK(trace) = {
    .abi = MISBEHAVE_ABI,
    .name = "trace",
    FL_TABLE(parameter, trace_parameters),
    .parameters_size = sizeof(struct trace),
    .step = trace_step,
    .safe = trace_safe,
    .terminate = trace_terminate,
};
