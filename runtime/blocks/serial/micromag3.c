#include "micromag3_frame.h"

#include <flotilla/driver.h>
#include <flotilla/sensor.h>
#include <stdio.h>

enum { XOR, NONE };
enum { STREAM, POLL, RAW };
enum { OUT_HEADING, OUT_FIELD, OUT_ERROR, OUT_FLAG };
enum { SILENT_MS = 3000 }; /* longer than the slowest stream pauses: the board was switched on anew */

static const double PI = 3.14159265358979323846;

struct micromag3 {
    FL_SERIAL_MEMBERS;
    int mode, checksum;
    int64_t pollfreq;
    double timeout;
};

static const struct fl_parameter parameters[] = {
    FL_SERIAL_PARAMETERS(struct micromag3, "9600"),
    FL_PARAMETER(struct micromag3, mode, .fallback = "stream", .choices = "stream|poll|raw",
                 .summary =
                     "stream: the board sends by itself (go); poll: one sample after the other is asked for (s?); "
                     "raw: the same, uncorrected and without a heading (sr?)"),
    FL_PARAMETER(struct micromag3, pollfreq, .fallback = "8", .min = 0, .max = 16, .unit = "Hz",
                 .summary = "rate of the stream; 0 is one sample in two seconds"),
    FL_PARAMETER(struct micromag3, checksum, .fallback = "xor", .choices = "xor|none",
                 .summary = "none: whatever the board sends as checksum is taken"),
    FL_SENSOR_TIMEOUT(struct micromag3, "0.5"),
};

static const struct fl_port outputs[] = {
    [OUT_HEADING] = {.name = "heading",
                     .type = FL_DOUBLE,
                     .width = 1,
                     .unit = "rad",
                     .summary = "from magnetic north, clockwise, 0 to 2 pi; stays 0 in mode raw"},
    [OUT_FIELD] = {.name = "field",
                   .type = FL_DOUBLE,
                   .width = 3,
                   .summary = "magnetic field along x, y and z, in the board's units; stays as it was where the board "
                              "is configured to send headings only"},
    [OUT_ERROR] = {.name = "error",
                   .type = FL_UINT16,
                   .width = 1,
                   .summary = "the board's error code of the newest sample, 0: none; others make the flag 0"},
    FL_SENSOR_OUTPUTS};

/* --- the conversation: stop, set the rate, go on; each command once the one before was answered, or 100 ms later ---
 */

enum stage { STOPPING, SETTING, RUNNING };

struct parser {
    struct micromag3_parser frames;
    uint8_t stage, answered;
    bool sampled; /* since the last question */
};

static bool feed(void *parser, uint8_t byte, void *sample)
{
    struct parser *self = parser;
    bool complete = micromag3_feed(&self->frames, byte, sample);
    self->sampled |= complete;
    return complete;
}

static size_t converse(void *parser, const void *given, int silent_ms, uint8_t *out, size_t size)
{
    static const char *const begin[] = {[STREAM] = "go\r", [POLL] = "s?\r", [RAW] = "sr?\r"};
    const struct micromag3 *micromag3 = given;
    struct parser *self = parser;
    if (silent_ms == FL_SERIAL_CLOSING)
        return (size_t)snprintf((char *)out, size, "h\r");
    if (silent_ms == FL_SERIAL_OPENED || (self->stage == RUNNING && silent_ms > SILENT_MS)) {
        self->frames.any_checksum = micromag3->checksum == NONE;
        self->stage = STOPPING;
        return (size_t)snprintf((char *)out, size, "h\r");
    }
    bool answered = self->answered != self->frames.answers;
    self->answered = self->frames.answers;
    if (self->stage == RUNNING) {
        bool ask = micromag3->mode != STREAM && (self->sampled || silent_ms > 0);
        self->sampled = false;
        return ask ? (size_t)snprintf((char *)out, size, "%s", begin[micromag3->mode]) : 0;
    }
    if (!answered && silent_ms == 0)
        return 0;
    if (self->stage++ == STOPPING)
        return (size_t)snprintf((char *)out, size, "pollfreq=%d\r", (int)micromag3->pollfreq);
    return (size_t)snprintf((char *)out, size, "%s", begin[micromag3->mode]);
}

static const struct fl_serial_protocol protocol = {
    .parser_size = sizeof(struct parser),
    .sample_size = sizeof(struct micromag3_sample),
    .feed = feed,
    .send = converse,
};

/* --- the block --- */

struct state {
    struct fl_serial *serial;
    struct fl_sensor sensor;
};

static int start(struct fl_block *block)
{
    const struct micromag3 *micromag3 = block->parameters;
    struct state *state = block->state;
    state->serial = fl_serial_start(block, &protocol, FL_SERIAL_SETTINGS(micromag3), block->parameters);
    return state->serial ? FL_OK : FL_FAILED;
}

static int initialize(struct fl_block *block)
{
    fl_sensor_begin(&((struct state *)block->state)->sensor);
    return FL_OK;
}

static int step(struct fl_block *block)
{
    const struct micromag3 *micromag3 = block->parameters;
    struct state *state = block->state;
    struct micromag3_sample sample;
    int64_t arrived_ns;
    uint32_t sequence;
    if (fl_serial_newest(state->serial, &sample, &arrived_ns, &sequence)) {
        FL_OUT(block, OUT_ERROR, uint16_t) = sample.error;
        if (sample.error) {
            fl_sensor_invalidate(&state->sensor);
        } else {
            if (sample.contains & MICROMAG3_HEADING)
                FL_OUT(block, OUT_HEADING, double) = sample.heading * PI / 180;
            for (int axis = 0; axis < 3 && sample.contains & MICROMAG3_FIELD; axis++)
                ((double *)block->out[OUT_FIELD])[axis] = sample.field[axis];
            fl_sensor_update(&state->sensor, arrived_ns, sequence);
        }
    }
    fl_sensor_outputs(&state->sensor, block, OUT_FLAG, fl_serial_connected(state->serial), micromag3->timeout);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    fl_serial_stop(state->serial);
    state->serial = NULL;
}

FL_BLOCK(micromag3) = {
    .abi = FL_ABI,
    .name = "micromag3",
    .summary = "PNI MicroMag3 magnetometer on its RS-232 CommBoard",
    .source = "PNI Legacy CommBoard user manual, pages 8 to 22",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct micromag3),
    .state_size = sizeof(struct state),
    .start = start,
    .initialize = initialize,
    .step = step,
    .terminate = terminate,
};
