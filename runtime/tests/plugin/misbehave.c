/* Plug-in with blocks that do what a block must not, and one that leaves a trace: for the tests of the executive. */
#include <fcntl.h>
#include <flotilla/block.h>
#include <flotilla/driver.h>
#include <stdatomic.h>
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
    FL_PARAMETER(struct misbehave, manner,
                 .choices = "fail|hang|late|allocate|start-fail|fault|abort|exit|"
                            "overflow|thread-fault|thread-exit|safe-fault|safe-hang|safe-not|terminate-hang"),
    FL_PARAMETER(struct misbehave, from, .default_value = "0"),
    FL_PARAMETER(struct misbehave, until, .default_value = "1000000000"),
    FL_PARAMETER(struct misbehave, late_s, .default_value = "0.025"),
};

enum {
    FAIL,
    HANG,
    LATE,
    ALLOCATE,
    START_FAIL,
    FAULT,
    ABORT,
    EXIT,
    OVERFLOW,
    THREAD_FAULT,
    THREAD_EXIT,
    SAFE_FAULT, /* a fault in the step, and another in what follows */
    SAFE_HANG,
    SAFE_NOT, /* and its step fails */
    TERMINATE_HANG,
};

struct misbehaving {
    struct fl_driver *driver;
    atomic_bool now; /* for the thread */
};

static void fault(void)
{
    volatile int *volatile nowhere = NULL;
    *nowhere = 1;
}

static int overflow(volatile int depth)
{
    volatile char large[4096] = {0};
    return depth < 0 ? 0 : overflow(depth + 1) + large[depth % 4096];
}

static void thread(struct fl_driver *driver, void *context)
{
    struct fl_block *block = context;
    const struct misbehave *parameters = block->parameters;
    struct misbehaving *state = block->state;
    while (fl_driver_wait(driver, -1, false, 1) == 0) {
        if (!state->now)
            continue;
        if (parameters->manner == THREAD_EXIT)
            exit(0);
        fault();
    }
}

static int misbehave_start(struct fl_block *block)
{
    const struct misbehave *parameters = block->parameters;
    struct misbehaving *state = block->state;
    if (parameters->manner == START_FAIL)
        return fl_fail(block, "the device is on fire");
    if (parameters->manner == THREAD_FAULT || parameters->manner == THREAD_EXIT)
        state->driver = fl_driver_start(block, thread, block);
    return FL_OK;
}

static void misbehave_safe(struct fl_block *block)
{
    const struct misbehave *parameters = block->parameters;
    if (parameters->manner == SAFE_FAULT)
        fault();
    while (parameters->manner == SAFE_HANG)
        pause();
    if (parameters->manner == SAFE_NOT)
        fl_not_safe(block, "the bus is down");
}

static void misbehave_terminate(struct fl_block *block)
{
    const struct misbehave *parameters = block->parameters;
    const struct misbehaving *state = block->state;
    while (parameters->manner == TERMINATE_HANG)
        pause();
    fl_driver_stop(state->driver);
}

static int misbehave_step(struct fl_block *block)
{
    const struct misbehave *parameters = block->parameters;
    struct misbehaving *state = block->state;
    if ((int64_t)block->step < parameters->from || (int64_t)block->step >= parameters->until)
        return FL_OK;
    switch (parameters->manner) {
    case FAIL:
    case SAFE_NOT:
        return fl_fail(block, "failed as asked in step %d", (int)block->step);
    case HANG:
        for (;;)
            pause();
    case LATE:
        for (int64_t end_ns = fl_now_ns() + (int64_t)(parameters->late_s * 1e9); fl_now_ns() < end_ns;)
            continue;
        return FL_OK;
    case ABORT:
    case SAFE_HANG:
        abort();
    case EXIT:
        exit(0);
    case OVERFLOW:
        return overflow(0);
    case THREAD_FAULT:
    case THREAD_EXIT:
        state->now = true;
        return FL_OK;
    case TERMINATE_HANG:
        return FL_OK;
    case ALLOCATE: {
        void *volatile memory = malloc(100);
        free(memory);
        return FL_OK;
    }
    default:
        fault();
        return FL_OK;
    }
}

FL_BLOCK(misbehave) = {
    .abi = MISBEHAVE_ABI,
    .name = "misbehave",
    FL_TABLE(parameter, misbehave_parameters),
    .parameters_size = sizeof(struct misbehave),
    .state_size = sizeof(struct misbehaving),
    .start = misbehave_start,
    .step = misbehave_step,
    .safe = misbehave_safe,
    .terminate = misbehave_terminate,
};

/* An actuator whose device is a file: "on" by steps, "reset" by safe and terminate. */
struct trace {
    struct fl_device device;
    double timeout;
};

static const struct fl_parameter trace_parameters[] = {
    FL_PARAMETER(struct trace, device),
    FL_PARAMETER(struct trace, timeout, .flags = FL_ACTUATOR_TIMEOUT, .default_value = "1"),
};

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

/* Counts a second from its step `from` on, and writes into a trace's file then. */
struct witness {
    const char *file;
    int64_t from;
};

static const struct fl_parameter witness_parameters[] = {
    FL_PARAMETER(struct witness, file),
    FL_PARAMETER(struct witness, from),
};

static void witness_thread(struct fl_driver *driver, void *context)
{
    struct fl_block *block = context;
    const struct witness *parameters = block->parameters;
    struct misbehaving *state = block->state;
    int naps = 0; /* a computer that stands still makes one longer */
    while (fl_driver_wait(driver, -1, false, 25) == 0) {
        if (!state->now || ++naps != 40)
            continue;
        int fd = open(parameters->file, O_WRONLY | O_APPEND);
        if (fd >= 0 && write(fd, "second\n", 7) > 0)
            close(fd);
    }
}

static int witness_start(struct fl_block *block)
{
    struct misbehaving *state = block->state;
    state->driver = fl_driver_start(block, witness_thread, block);
    return state->driver ? FL_OK : FL_FAILED;
}

static int witness_step(struct fl_block *block)
{
    const struct witness *parameters = block->parameters;
    struct misbehaving *state = block->state;
    state->now = (int64_t)block->step >= parameters->from;
    return FL_OK;
}

FL_BLOCK(witness) = {
    .abi = MISBEHAVE_ABI,
    .name = "witness",
    FL_TABLE(parameter, witness_parameters),
    .parameters_size = sizeof(struct witness),
    .state_size = sizeof(struct misbehaving),
    .start = witness_start,
    .step = witness_step,
    .terminate = misbehave_terminate,
};
