/* Datagrams that come at their times, with the outputs of udp-receive that takes them in their order: in place of a
 * network, for tasks that run by a clock that counts. They are in a file: for each one the time of its arrival, a
 * double in s after the task's start, and its bytes; as this computer has numbers. */
#include <errno.h>
#include <flotilla/block.h>
#include <stdio.h>
#include <string.h>

struct datagrams {
    const char *file;
    int64_t length;
    double timeout;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct datagrams, file, .summary = "time and bytes of each datagram, by time"),
    FL_PARAMETER(struct datagrams, length, .min = 1, .max = 65507, .unit = "B", .summary = "of a datagram"),
    FL_PARAMETER(struct datagrams, timeout, .min = 1e-3, .max = 3600, .unit = "s",
                 .summary = "older ones are not good"),
};

enum { FLAG, AGE, SEQUENCE, DATA };
static const struct fl_port outputs[] = {
    {.name = "flag", .type = FL_BOOLEAN, .width = 1, .summary = "1: not older than `timeout`"},
    {.name = "age", .type = FL_DOUBLE, .width = 1, .unit = "s", .summary = "since the datagram arrived"},
    {.name = "sequence", .type = FL_UINT32, .width = 1, .summary = "increases with each"},
};

struct state {
    FILE *file;
    double now, arrived, next; /* next: of the one that waits */
    uint8_t *waiting;
    bool more;
};

static void look(struct state *state, size_t length)
{
    state->more = fread(&state->next, sizeof state->next, 1, state->file) == 1 &&
                  fread(state->waiting, length, 1, state->file) == 1;
}

static int configure(struct fl_block *block)
{
    const struct datagrams *set = block->parameters;
    return fl_add_output(
        block, (struct fl_port){
                   .name = "data", .type = FL_UINT8, .width = (uint32_t)set->length, .summary = "the last one taken"});
}

static int start(struct fl_block *block)
{
    const struct datagrams *set = block->parameters;
    struct state *state = block->state;
    state->waiting = fl_allocate(block, (size_t)set->length);
    if (!state->waiting)
        return FL_FAILED;
    state->file = fopen(set->file, "rb");
    if (!state->file)
        return fl_fail(block, "%s: %s", set->file, strerror(errno));
    look(state, (size_t)set->length);
    return FL_OK;
}

static int step(struct fl_block *block)
{
    const struct datagrams *set = block->parameters;
    struct state *state = block->state;
    state->now += fl_interval_s(block);
    if (state->more && state->next <= state->now) {
        memcpy(block->out[DATA], state->waiting, (size_t)set->length);
        state->arrived = state->next;
        FL_OUT(block, SEQUENCE, uint32_t)++;
        look(state, (size_t)set->length);
    }
    double age = state->now - state->arrived;
    FL_OUT(block, AGE, double) = age;
    FL_OUT(block, FLAG, bool) = FL_OUT(block, SEQUENCE, uint32_t) && age <= set->timeout;
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    if (state->file)
        fclose(state->file);
}

FL_BLOCK(datagrams) = {
    .abi = FL_ABI,
    .name = "datagrams",
    .summary = "hands over datagrams of a file as if they came by the network",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct datagrams),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .terminate = terminate,
};
