/** ir104-pbf
 *
 * Drives the relays of a relay board with 20 relays and 20 optically isolated inputs at eight I/O ports, and reads its
 * inputs.
 *
 * The block has the whole board: relays that `channels` does not list stay off. `safe` needs no step before it: start,
 * safe, terminate, one after the other in one thread, put the board into its reset state, whatever ran before and
 * however it ended. The thread that steps must be the one that started the block, or one begun by it since
 * (ioperm(2)).
 *
 * After a start of the task's service the relays stay in `reset` until a new command was equal to it, unless the task
 * says `restart: resume`.
 *
 * Failure: Once no new command came for `timeout`, counted from the first step on, the relays go to `reset` and
 * `timed_out` is 1, until the next new command. When the task ends, in whatever way, the relays go to `reset` as long
 * as the process can act. `mismatch` is 1 while relays do not read back as written, which the journal says once.
 * Without the privilege for I/O ports the start fails.
 */
#include "ports.h"

#include <errno.h>
#include <flotilla/driver.h>
#include <inttypes.h>
#include <math.h>
#include <string.h>

enum {
    PORTS = 8,
    RELAYS_AT = 0, /* three registers, write and read back; 1: energised */
    INPUTS_AT = 4, /* three registers, read; 0: driven */
    RELAYS = 20,
    INPUTS = 20,
};
#define ALL_RELAYS ((UINT32_C(1) << RELAYS) - 1)

struct ir104 {
    int base;
    struct fl_doubles channels, initial, reset;
    int fresh;
    double timeout;
};

enum fresh { BY_FLAG, BY_SEQUENCE };

static const uint16_t bases[] = {0x240, 0x260, 0x280, 0x300};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct ir104, base, .flags = FL_EXCLUSIVE | FL_IO_PORTS, .default_value = "0x300",
                 .choices = "0x240|0x260|0x280|0x300", .summary = "address of the board, as its jumpers say"),
    FL_PARAMETER(struct ir104, channels, .default_value = "", .min = 1, .max = RELAYS,
                 .summary = "relays to drive, in the order of `command`; the others stay off; none: read inputs only"),
    FL_PARAMETER(struct ir104, initial, .default_value = "0", .min = 0, .max = 1,
                 .summary = "relays until the first command: one value for each channel, or one for all; 1: on"),
    FL_PARAMETER(struct ir104, reset, .default_value = "0", .min = 0, .max = 1,
                 .summary =
                     "relays after a time-out and at the end: one value for each channel, or one for all; 1: on"),
    FL_PARAMETER(struct ir104, fresh, .default_value = "flag", .choices = "flag|sequence",
                 .summary = "what marks a new command: a flag of 1, or a changed sequence"),
    FL_PARAMETER(struct ir104, timeout, .flags = FL_ACTUATOR_TIMEOUT, .default_value = "0.1", .min = 0.001, .max = 60,
                 .unit = "s", .summary = "time without a new command after which the relays go to `reset`"),
};

static const struct fl_port outputs[] = {
    {.name = "inputs", .type = FL_BOOLEAN, .width = INPUTS, .summary = "opto inputs 1 to 20; 1: driven"},
    {.name = "mismatch", .type = FL_BOOLEAN, .width = 1, .summary = "1: a relay's bit reads back other than written"},
    {.name = "timed_out", .type = FL_BOOLEAN, .width = 1, .summary = "1: no command came in time, relays are reset"},
};

enum { COMMAND, FRESH };
enum { OPTO, MISMATCH, TIMED_OUT, READ_BACK };

struct state {
    bool permitted;
    uint16_t base;
    uint32_t initial, reset; /* all relays of the board: bit 0 is relay 1 */
    uint32_t channels;       /* those that are driven */
    uint32_t commanded;
    int64_t commanded_ns; /* when the last command was new */
    uint32_t sequence;
    struct fl_step_reasons *reasons;
};

static unsigned channel(const struct ir104 *ir104, size_t index)
{
    return (unsigned)ir104->channels.value[index] - 1;
}

static int check_channels(struct fl_block *block, const struct fl_doubles *channels)
{
    uint32_t seen = 0;
    for (size_t i = 0; i < channels->count; i++) {
        double number = channels->value[i];
        if (number != floor(number))
            return fl_fail(block, "parameter channels: %g is not a relay's number", number);
        uint32_t bit = UINT32_C(1) << ((unsigned)number - 1);
        if (seen & bit)
            return fl_fail(block, "parameter channels: relay %g is given twice", number);
        seen |= bit;
    }
    return FL_OK;
}

static int check_vector(struct fl_block *block, const char *name, const struct fl_doubles *vector, size_t channels)
{
    if (vector->count != 1 && vector->count != channels)
        return fl_fail(block, "parameter %s: %zu values for %zu channels; give as many, or one for all", name,
                       vector->count, channels);
    for (size_t i = 0; i < vector->count; i++)
        if (vector->value[i] != floor(vector->value[i]))
            return fl_fail(block, "parameter %s: %g is neither 0 nor 1", name, vector->value[i]);
    return FL_OK;
}

static int configure(struct fl_block *block)
{
    const struct ir104 *ir104 = block->parameters;
    uint32_t width = (uint32_t)ir104->channels.count;
    if (check_channels(block, &ir104->channels) != FL_OK ||
        check_vector(block, "initial", &ir104->initial, width) != FL_OK ||
        check_vector(block, "reset", &ir104->reset, width) != FL_OK)
        return FL_FAILED;
    if (!width) /* its inputs alone are wanted */
        return FL_OK;
    const struct fl_port command = {
        .name = "command", .type = FL_BOOLEAN, .width = width, .summary = "1: relay on; in the order of `channels`"};
    const struct fl_port flag = {.name = "flag", .type = FL_BOOLEAN, .width = 1, .summary = "1: the command is good"};
    const struct fl_port sequence = {
        .name = "sequence", .type = FL_UINT32, .width = 1, .summary = "changes with each new command"};
    const struct fl_port relays = {
        .name = "relays", .type = FL_BOOLEAN, .width = width, .summary = "the channels' relays as read back; 1: on"};
    if (fl_add_input(block, command) != FL_OK)
        return FL_FAILED;
    if (fl_add_input(block, ir104->fresh == BY_FLAG ? flag : sequence) != FL_OK)
        return FL_FAILED;
    return fl_add_output(block, relays);
}

static uint32_t relays_of(const struct ir104 *ir104, const struct fl_doubles *vector)
{
    uint32_t relays = 0;
    for (size_t i = 0; i < ir104->channels.count; i++)
        if (vector->value[vector->count == 1 ? 0 : i] != 0)
            relays |= UINT32_C(1) << channel(ir104, i);
    return relays;
}

static void write_relays(const struct state *state, uint32_t relays)
{
    for (unsigned i = 0; i < 3; i++)
        port_space->out((uint16_t)(state->base + RELAYS_AT + i), (uint8_t)(relays >> 8 * i));
}

static uint32_t read_bits(const struct state *state, unsigned at)
{
    uint32_t bits = 0;
    for (unsigned i = 0; i < 3; i++)
        bits |= (uint32_t)port_space->in((uint16_t)(state->base + at + i)) << 8 * i;
    return bits;
}

static int start(struct fl_block *block)
{
    const struct ir104 *ir104 = block->parameters;
    struct state *state = block->state;
    state->base = bases[ir104->base];
    state->initial = relays_of(ir104, &ir104->initial);
    state->reset = relays_of(ir104, &ir104->reset);
    state->channels = relays_of(ir104, &(struct fl_doubles){1, (const double[]){1}});
    int error = port_space->permit(state->base, PORTS, true);
    if (error == EPERM)
        return fl_fail(block,
                       "I/O ports 0x%x to 0x%x need the privilege CAP_SYS_RAWIO: run as root, or let the service have "
                       "it (AmbientCapabilities=CAP_SYS_RAWIO)",
                       state->base, state->base + PORTS - 1);
    if (error)
        return fl_fail(block, "I/O ports 0x%x to 0x%x: %s", state->base, state->base + PORTS - 1, strerror(error));
    state->permitted = true;
    state->reasons = fl_step_reasons_start(block);
    return state->reasons ? FL_OK : FL_FAILED;
}

static int initialize(struct fl_block *block)
{
    struct state *state = block->state;
    state->commanded = fl_may_act(block, false) ? state->initial : state->reset;
    write_relays(state, state->commanded);
    return FL_OK;
}

static bool is_new(const struct fl_block *block, struct state *state)
{
    const struct ir104 *ir104 = block->parameters;
    if (!ir104->channels.count)
        return true;
    if (ir104->fresh == BY_FLAG)
        return FL_IN(block, FRESH, bool);
    uint32_t before = state->sequence;
    state->sequence = FL_IN(block, FRESH, uint32_t);
    return state->sequence != before;
}

static void command(struct fl_block *block, struct state *state)
{
    const struct ir104 *ir104 = block->parameters;
    bool new = is_new(block, state);
    if (new || block->step == 0) /* the initial state, too, lasts no longer than a command */
        state->commanded_ns = block->release_ns;
    if (new) {
        state->commanded = 0;
        for (size_t i = 0; i < ir104->channels.count; i++)
            if (((const bool *)block->in[COMMAND])[i])
                state->commanded |= UINT32_C(1) << channel(ir104, i);
    }
    bool waits = ir104->channels.count && !fl_may_act(block, new && state->commanded == state->reset);
    if (waits)
        state->commanded = state->reset;
    if (block->release_ns - state->commanded_ns > llround(ir104->timeout * 1e9)) {
        FL_OUT(block, TIMED_OUT, bool) = true;
        state->commanded = state->reset;
    } else {
        FL_OUT(block, TIMED_OUT, bool) = false;
    }
}

static int step(struct fl_block *block)
{
    const struct ir104 *ir104 = block->parameters;
    struct state *state = block->state;
    command(block, state);
    /* Write in each step: a board that lost its power meanwhile then restores its relays. */
    write_relays(state, state->commanded);
    uint32_t read_back = read_bits(state, RELAYS_AT), opto = read_bits(state, INPUTS_AT);
    FL_OUT(block, MISMATCH, bool) = (read_back & ALL_RELAYS) != state->commanded;
    if (FL_OUT(block, MISMATCH, bool))
        fl_step_reasons_log(state->reasons, "relays do not read back as they were written: look at the board's jumper "
                                            "for `base`, and at its power");
    for (size_t i = 0; i < ir104->channels.count; i++)
        ((bool *)block->out[READ_BACK])[i] = read_back >> channel(ir104, i) & 1;
    for (unsigned i = 0; i < INPUTS; i++)
        ((bool *)block->out[OPTO])[i] = !(opto >> i & 1);
    return FL_OK;
}

static void safe(struct fl_block *block)
{
    struct state *state = block->state;
    if (!state->permitted)
        return;
    /* A thread that was started before `start` may not use the ports, and its failure may be what ends the task. */
    if (port_space->permit(state->base, PORTS, true)) {
        fl_not_safe(block, "it may not use the board's ports");
        return;
    }
    state->commanded = state->reset;
    write_relays(state, state->reset);
    if ((read_bits(state, RELAYS_AT) ^ state->reset) & state->channels)
        fl_not_safe(block, "relays do not read back as they were written");
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    safe(block);
    fl_step_reasons_stop(state->reasons);
    if (state->permitted)
        port_space->permit(state->base, PORTS, false);
    state->permitted = false;
}

FL_BLOCK(ir104_pbf) = {
    .abi = FL_ABI,
    .name = "ir104-pbf",
    .summary =
        "relay board with 20 relays and 20 opto inputs: inputs `command` and `flag` or `sequence`, an output `relays`",
    .source = "Diamond Systems, IR-104-PBF User Manual: register map",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct ir104),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .initialize = initialize,
    .step = step,
    .safe = safe,
    .terminate = terminate,
};
