/** command-guard
 *
 * Lets the commands of one operator pass, and none while a second one commands. A command is a datagram that begins
 * with `operator` and `sequence`, both uint32, little-endian. A sender draws a number of an operator at random, 1 to
 * 2³² − 1, each time it begins, and counts its datagrams up. Connect a block that hands over each datagram, such as
 * udp-receive with `take: in-order`: of two that come in one step both have to be seen.
 *
 * The block knows the last 8 operators. It tells senders apart, and mistakes from commands. It is no authentication.
 *
 * Equations:
 *   fresh = operator ≠ 0, and 0 < sequence − (last sequence of this operator) < 2³¹ modulo 2³²; a new operator's is
 *   speaks(i) = (time since the last fresh datagram of operator i arrived) ≤ apart
 *   conflict = two or more operators speak
 *   operator = whose second fresh datagram since it speaks comes while the one before does not speak any more
 *   data, age = of the last fresh datagram of `operator`
 *   out flag = (in flag) and (age ≤ timeout) and not conflict
 *
 * Failure: The flag is 0 as the equation says; `data` then stays. Datagrams that are not fresh (repeated, overtaken,
 * recorded and played again) are counted in `refused` and change nothing else, as do those of an `age` that is no time.
 */
#include <flotilla/block.h>
#include <math.h>
#include <string.h>

struct guard {
    int64_t length;
    double apart, timeout;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct guard, length, .min = 8, .max = 65507, .unit = "B", .summary = "bytes of a datagram"),
    FL_PARAMETER(struct guard, apart, .flags = FL_TUNABLE | FL_SAFETY, .default_value = "1", .min = 1e-3, .max = 3600,
                 .unit = "s", .summary = "an operator that is silent for longer does not speak any more"),
    FL_PARAMETER(struct guard, timeout, .flags = FL_TUNABLE | FL_SAFETY, .default_value = "0.3", .min = 1e-3,
                 .max = 3600, .unit = "s", .summary = "older commands are none"),
};

enum { IN_FLAG, IN_AGE, IN_SEQUENCE, IN_DATA };

static const struct fl_port inputs[] = {
    {.name = "flag", .type = FL_BOOLEAN, .width = 1, .summary = "1: datagrams come"},
    {.name = "age", .type = FL_DOUBLE, .width = 1, .unit = "s", .summary = "since the datagram in `data` arrived"},
    {.name = "sequence", .type = FL_UINT32, .width = 1, .summary = "changes with each datagram"},
};

enum { FLAG, AGE, OPERATOR, OTHER, CONFLICT, REFUSED, DATA };

static const struct fl_port outputs[] = {
    {.name = "flag", .type = FL_BOOLEAN, .width = 1, .summary = "1: one operator commands"},
    {.name = "age", .type = FL_DOUBLE, .width = 1, .unit = "s", .summary = "since the command in `data` arrived"},
    {.name = "operator", .type = FL_UINT32, .width = 1, .summary = "whose command it is; 0: there was none yet"},
    {.name = "other", .type = FL_UINT32, .width = 1, .summary = "in a conflict the other one; else 0"},
    {.name = "conflict", .type = FL_BOOLEAN, .width = 1, .summary = "1: several operators speak"},
    {.name = "refused",
     .type = FL_UINT32,
     .width = 1,
     .flags = FL_REFUSALS,
     .summary = "datagrams that were not fresh"},
};

enum { OPERATORS = 8, TRUSTED = 2 };

struct operator {
    uint32_t number; /* 0: none */
    uint32_t sequence;
    int64_t heard_ns;
    unsigned fresh; /* datagrams since it speaks, up to TRUSTED */
};

struct state {
    int64_t now_ns; /* since the first step */
    uint32_t sequence;
    struct operator operators[OPERATORS];
    struct operator *current; /* whose commands pass; NULL: nobody's yet */
};

static int configure(struct fl_block *block)
{
    const struct guard *guard = block->parameters;
    struct fl_port data = {.name = "data",
                           .type = FL_UINT8,
                           .width = (uint32_t)guard->length,
                           .summary = "datagram: operator and sequence first"};
    if (fl_add_input(block, data) != FL_OK)
        return FL_FAILED;
    data.summary = "last datagram that passed";
    return fl_add_output(block, data);
}

static uint32_t word(const uint8_t *bytes)
{
    return bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

static int64_t ns(double seconds)
{
    return llround(seconds * 1e9);
}

static bool speaks(const struct fl_block *block, const struct operator *one)
{
    const struct guard *guard = block->parameters;
    const struct state *state = block->state;
    return one->number && state->now_ns - one->heard_ns <= ns(guard->apart);
}

/* Its place, or that of the one which was silent for longest and whose commands do not pass. */
static struct operator *place_of(struct state *state, uint32_t number)
{
    struct operator *silent = NULL;
    for (struct operator *one = state->operators; one < state->operators + OPERATORS; one++) {
        if (one->number == number)
            return one;
        if (one != state->current && (!silent || !one->number || (silent->number && one->heard_ns < silent->heard_ns)))
            silent = one;
    }
    return silent;
}

/* Whether the datagram is fresh; then its operator was heard. */
static bool hear(struct fl_block *block, const uint8_t *data)
{
    struct state *state = block->state;
    uint32_t number = word(data), sequence = word(data + 4);
    double age = FL_IN(block, IN_AGE, double);
    if (!number || !(age >= 0 && age <= 3600))
        return false;
    struct operator *one = place_of(state, number);
    if (one->number != number)
        *one = (struct operator){.number = number};
    else if (sequence - one->sequence - 1 >= INT32_MAX)
        return false;
    if (!speaks(block, one))
        one->fresh = 0;
    one->sequence = sequence;
    one->heard_ns = state->now_ns - ns(age);
    if (one->fresh < TRUSTED)
        one->fresh++;
    if (one->fresh == TRUSTED && (!state->current || !speaks(block, state->current)))
        state->current = one;
    if (one == state->current && one->fresh == TRUSTED)
        memcpy(block->out[DATA], data, block->out_ports[DATA].width);
    return true;
}

/* How many speak. If several do, `other` is the last one heard of those whose commands do not pass. */
static unsigned count(struct fl_block *block, uint32_t *other)
{
    struct state *state = block->state;
    const struct operator *last = NULL;
    unsigned speaking = 0;
    for (const struct operator *one = state->operators; one < state->operators + OPERATORS; one++) {
        if (!speaks(block, one))
            continue;
        speaking++;
        if (one != state->current && (!last || one->heard_ns > last->heard_ns))
            last = one;
    }
    *other = last && speaking > 1 ? last->number : 0;
    return speaking;
}

static int step(struct fl_block *block)
{
    const struct guard *guard = block->parameters;
    struct state *state = block->state;
    state->now_ns += block->interval_ns;
    if (FL_IN(block, IN_SEQUENCE, uint32_t) != state->sequence && !hear(block, block->in[IN_DATA]))
        FL_OUT(block, REFUSED, uint32_t)++;
    state->sequence = FL_IN(block, IN_SEQUENCE, uint32_t);
    const struct operator *current = state->current;
    bool conflict = count(block, &FL_OUT(block, OTHER, uint32_t)) > 1, in_flag = FL_IN(block, IN_FLAG, uint8_t);
    int64_t age_ns = state->now_ns - (current ? current->heard_ns : 0);
    FL_OUT(block, FLAG, bool) =
        in_flag && current && current->fresh == TRUSTED && age_ns <= ns(guard->timeout) && !conflict;
    FL_OUT(block, AGE, double) = 1e-9 * (double)age_ns;
    FL_OUT(block, OPERATOR, uint32_t) = current ? current->number : 0;
    FL_OUT(block, CONFLICT, bool) = conflict;
    return FL_OK;
}

FL_BLOCK(command_guard) = {
    .abi = FL_ABI,
    .name = "command-guard",
    .summary = "lets the commands of one operator pass, and none while a second one commands",
    .source = "RFC 1982: serial number arithmetic",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct guard),
    .state_size = sizeof(struct state),
    .configure = configure,
    .step = step,
};
