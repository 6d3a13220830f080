/** dsp3000
 *
 * Reads a KVH DSP-3000 fibre-optic gyro on a serial port: the angular rate, increments of the angle, or the angle.
 *
 * Equations:
 *   value in rad or rad/s = degrees·π/180, negated for `positive: counterclockwise`
 *   increment = sum of all increments that came since the step before;  angle between −π and π
 *
 * Failure: The flag is 0 once no measurement came for `timeout`, while the port is closed, and from a measurement on
 * that the gyro marks as a fault or that is beyond `full_scale`. While the flag is 0 the values stay the last good
 * ones, and `age` grows. The increment is 0 instead in a step to which a bad one came, or the first one after some that
 * were lost. After each start, and after a silence, measurements count once the gyro has surely taken the mode. A word
 * counts a millisecond late, once the word after it is right, too: where bytes were lost, halves of two words can look
 * like one. A port that is missing or in use is opened again every 100 ms; the journal says once what is wrong.
 */
#include "dsp3000_frame.h"

#include <flotilla/driver.h>
#include <flotilla/sensor.h>
#include <math.h>

enum { TEXT, WORDS };
enum { CLOCKWISE, COUNTERCLOCKWISE };
enum { IN_ZERO };
enum { OUT_VALUE, OUT_FLAG };

/* The gyro accepts a command only between two of its frames, and does not acknowledge it. A line of text does not show
 * the mode, and a steady angle looks like a steady rate. So the mode is sent after each line until it has surely been
 * accepted (if a fifth of the commands is lost: 0.2^10, one start in ten million), and lines count only then. Later it
 * is sent from time to time, so that a gyro that was switched on again unnoticed is back in its mode within a second.
 * Only Z changes the angle, P does not.
 */
enum {
    REPEATS = 10,
    SETTLING = 2,  /* lines after the last command that may still be of another mode */
    REFRESH = 100, /* lines between two later commands */
    ZEROS = 3,     /* times that Z is said */
};

static const double PI = 3.14159265358979323846;

struct dsp3000 {
    FL_SERIAL_MEMBERS;
    int format, mode, positive;
    double full_scale, timeout;
};

static const struct fl_parameter parameters[] = {
    FL_SERIAL_PARAMETERS(struct dsp3000, "38400"),
    FL_PARAMETER(struct dsp3000, format, .default_value = "text", .choices = "text|words",
                 .summary = "text: the 100 Hz gyro (-01, 38400 Bd); words: the 1000 Hz gyro (-07, 115200 Bd)"),
    FL_PARAMETER(struct dsp3000, mode, .default_value = "rate", .choices = "rate|incremental|integrated",
                 .summary = "what is measured: the angular rate, the angle since the last step, or since `zero`"),
    FL_PARAMETER(struct dsp3000, positive, .default_value = "clockwise", .choices = "clockwise|counterclockwise",
                 .summary = "sense of rotation, seen from above, that is positive; clockwise is the gyro's own"),
    FL_PARAMETER(struct dsp3000, full_scale, .default_value = "6.545", .min = 0.01, .max = 6.545, .unit = "rad/s",
                 .summary = "a faster rotation is a bad measurement"),
    FL_SENSOR_TIMEOUT(struct dsp3000, "0.05"),
};

static const struct fl_port inputs[] = {
    {.name = "zero",
     .type = FL_BOOLEAN,
     .width = 1,
     .flags = FL_OPTIONAL,
     .summary = "when it becomes 1, the integrated angle is counted from here"},
};

static const struct fl_port values[] = {
    [DSP3000_RATE] = {.name = "rate", .type = FL_DOUBLE, .width = 1, .unit = "rad/s", .summary = "angular rate"},
    [DSP3000_INCREMENTAL] = {.name = "increment",
                             .type = FL_DOUBLE,
                             .width = 1,
                             .unit = "rad",
                             .summary = "angle turned since the last step, each part of it counted once"},
    [DSP3000_INTEGRATED] = {.name = "angle",
                            .type = FL_DOUBLE,
                            .width = 1,
                            .unit = "rad",
                            .summary = "angle since `zero`, between -pi and pi"},
};

static const struct fl_port status[] = {FL_SENSOR_OUTPUTS};

/* --- the conversation --- */

struct parser {
    struct dsp3000_text text;
    struct dsp3000_words words;
    uint8_t repeats, settling, lines; /* commands and lines to come, lines since the last command */
    bool fault;                       /* the gyro tells one */
    double degrees;                   /* of the newest measurement */
};

static bool note(struct parser *self, const struct dsp3000_sample *sample)
{
    self->fault = !sample->valid;
    self->degrees = sample->degrees;
    return true;
}

static bool feed_text(void *parser, uint8_t byte, void *sample)
{
    struct parser *self = parser;
    if (!dsp3000_text_feed(&self->text, byte, sample))
        return false;
    note(self, sample);
    if (self->repeats || self->settling) {
        if (!self->repeats)
            self->settling--;
        ((struct dsp3000_sample *)sample)->valid = false;
    }
    return true;
}

static bool feed_words(void *parser, uint8_t byte, void *sample)
{
    struct parser *self = parser;
    return dsp3000_words_feed(&self->words, byte, sample) && note(self, sample);
}

static size_t say_mode(void *parser, const void *given, int silent_ms, uint8_t *out, size_t size)
{
    static const char commands[] = {[DSP3000_RATE] = 'R', [DSP3000_INCREMENTAL] = 'A', [DSP3000_INTEGRATED] = 'P'};
    const struct dsp3000 *dsp3000 = given;
    struct parser *self = parser;
    (void)size;
    /* After a silence the gyro may have been switched on again, and is then in rate mode. A word that it broke off has
     * no end. */
    if (silent_ms == FL_SERIAL_OPENED || silent_ms > 0) {
        self->words = (struct dsp3000_words){.mode = (uint8_t)dsp3000->mode, .gap = true};
        self->text.gap = true;
        self->repeats = REPEATS;
        self->settling = SETTLING;
    }
    bool ended = self->text.ended || dsp3000->format == WORDS; /* words come ten times as often */
    self->text.ended = false;
    if (silent_ms > 0 || silent_ms == FL_SERIAL_CLOSING || (silent_ms == 0 && !ended))
        return 0;
    if (self->repeats)
        self->repeats--;
    else if (dsp3000->format == WORDS || ++self->lines < REFRESH) /* a word tells its mode */
        return 0;
    self->lines = 0;
    *out = (uint8_t)commands[dsp3000->mode];
    return 1;
}

static const char *reason(void *parser, const void *given)
{
    const struct dsp3000 *dsp3000 = given;
    struct parser *self = parser;
    if (self->text.wrong) {
        self->text.wrong = false;
        return "a line is not the gyro's 21 bytes: check the cable and the format";
    }
    if (self->words.wrong) {
        self->words.wrong = false;
        return "the gyro sends words of another mode, and does not take the command: check its RxD line";
    }
    if (self->fault) {
        self->fault = false;
        return "the gyro reports a fault";
    }
    if (dsp3000->mode == DSP3000_RATE && fabs(self->degrees) * PI / 180 > dsp3000->full_scale) {
        self->degrees = 0;
        return "the gyro reports a rate beyond full_scale";
    }
    return NULL;
}

#define PROTOCOL(waiting, take)                                                                                        \
    {.parser_size = sizeof(struct parser),                                                                             \
     .sample_size = sizeof(struct dsp3000_sample),                                                                     \
     .records = (waiting),                                                                                             \
     .feed = (take),                                                                                                   \
     .send = say_mode,                                                                                                 \
     .reason = reason}

/* All increments are needed: the ring holds those of a second. */
static const struct fl_serial_protocol newest[] = {[TEXT] = PROTOCOL(0, feed_text), [WORDS] = PROTOCOL(0, feed_words)},
                                       each[] = {[TEXT] = PROTOCOL(128, feed_text),
                                                 [WORDS] = PROTOCOL(1024, feed_words)};

/* --- the block --- */

struct state {
    struct fl_serial *serial;
    struct fl_sensor sensor;
    double radians;     /* of a degree, with the sign */
    double most;        /* degrees, or degrees per second: limit of plausible values */
    uint32_t received;  /* measurements so far, bad ones too */
    bool zero;          /* the input of the last step */
    uint8_t zeros;      /* still to be sent, */
    uint32_t zeroed_at; /* but not again after the same measurement */
};

static int configure(struct fl_block *block)
{
    const struct dsp3000 *dsp3000 = block->parameters;
    int failed = fl_add_output(block, values[dsp3000->mode]);
    for (size_t i = 0; i < sizeof status / sizeof status[0]; i++)
        failed |= fl_add_output(block, status[i]);
    return failed;
}

static int start(struct fl_block *block)
{
    const struct dsp3000 *dsp3000 = block->parameters;
    struct state *state = block->state;
    const struct fl_serial_protocol *protocols = dsp3000->mode == DSP3000_INCREMENTAL ? each : newest;
    state->serial = fl_serial_start(block, &protocols[dsp3000->format], FL_SERIAL_SETTINGS(dsp3000), block->parameters);
    return state->serial ? FL_OK : FL_FAILED;
}

static int initialize(struct fl_block *block)
{
    const struct dsp3000 *dsp3000 = block->parameters;
    struct state *state = block->state;
    /* The burst rate is 3 % off at most, and an increment the longer. */
    double slowest_hz = 0.97 * (dsp3000->format == TEXT ? 100 : 1000), full_scale = dsp3000->full_scale * 180 / PI;
    state->radians = (dsp3000->positive == CLOCKWISE ? PI : -PI) / 180;
    state->most = dsp3000->mode == DSP3000_RATE          ? full_scale
                  : dsp3000->mode == DSP3000_INCREMENTAL ? full_scale / slowest_hz
                                                         : 360;
    fl_sensor_begin(&state->sensor);
    return FL_OK;
}

static bool believable(const struct state *state, const struct dsp3000_sample *sample)
{
    return sample->valid && fabs(sample->degrees) <= state->most;
}

static void take_newest(struct fl_block *block, enum dsp3000_mode mode)
{
    struct state *state = block->state;
    struct dsp3000_sample sample;
    int64_t arrived_ns;
    if (!fl_serial_newest(state->serial, &sample, &arrived_ns, &state->received))
        return;
    if (!believable(state, &sample)) {
        fl_sensor_invalidate(&state->sensor);
        return;
    }
    double value = sample.degrees * state->radians;
    FL_OUT(block, OUT_VALUE, double) = mode == DSP3000_RATE ? value : remainder(value, 2 * PI);
    fl_sensor_update(&state->sensor, arrived_ns, state->received);
}

/* Sum up all increments since the last step. A bad increment, or a lost one before them, makes the sum invalid. */
static void take_each(struct fl_block *block)
{
    struct state *state = block->state;
    struct dsp3000_sample sample;
    int64_t arrived_ns;
    uint32_t sequence;
    double sum = 0;
    bool good = true;
    while (fl_serial_next(state->serial, &sample, &arrived_ns, &sequence)) {
        good = good && believable(state, &sample) && sequence == state->received + 1 && !sample.gap;
        sum += sample.degrees * state->radians;
        state->received = sequence;
        if (good)
            fl_sensor_update(&state->sensor, arrived_ns, sequence);
        else
            fl_sensor_invalidate(&state->sensor);
    }
    FL_OUT(block, OUT_VALUE, double) = good ? sum : 0;
}

/* The gyro may miss a command and does not acknowledge it, so send it again after each of the next frames. */
static void zero(struct fl_block *block)
{
    struct state *state = block->state;
    bool wanted = FL_IN(block, IN_ZERO, bool);
    if (wanted && !state->zero) {
        state->zeros = ZEROS;
        state->zeroed_at = state->received - 1;
    }
    state->zero = wanted;
    if (state->zeros && state->zeroed_at != state->received && fl_serial_send(state->serial, (const uint8_t *)"Z", 1)) {
        state->zeros--;
        state->zeroed_at = state->received;
    }
}

static int step(struct fl_block *block)
{
    const struct dsp3000 *dsp3000 = block->parameters;
    struct state *state = block->state;
    if (dsp3000->mode == DSP3000_INCREMENTAL)
        take_each(block);
    else
        take_newest(block, (enum dsp3000_mode)dsp3000->mode);
    if (dsp3000->mode == DSP3000_INTEGRATED)
        zero(block);
    fl_sensor_outputs(&state->sensor, block, OUT_FLAG, fl_serial_connected(state->serial), dsp3000->timeout);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    fl_serial_stop(state->serial);
    state->serial = NULL;
}

FL_BLOCK(dsp3000) = {
    .abi = FL_ABI,
    .name = "dsp3000",
    .summary = "KVH DSP-3000 fibre-optic gyro on a serial port",
    .source = "KVH DSP-3000 technical manual 54-0215 Rev. C, sections 2 and 3",
    FL_TABLE(input, inputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct dsp3000),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .initialize = initialize,
    .step = step,
    .terminate = terminate,
};
