/** micromag3
 *
 * Reads a PNI MicroMag3 magnetometer on its RS-232 CommBoard: heading and magnetic field.
 *
 * Equations:
 *   heading in rad = degrees·π/180
 *
 * Failure: The flag is 0 once no sample came for `timeout`, while the port is closed, and from a sample on with an
 * error code, which `error` gives. While the flag is 0 the values stay the last good ones, and `age` grows. A sample
 * with a wrong checksum is dropped. A board that is silent for 3 s is set up again. A port that is missing or in use
 * is opened again every 100 ms; the journal says once what is wrong.
 */
#include "micromag3_frame.h"

#include <flotilla/driver.h>
#include <flotilla/sensor.h>
#include <stdio.h>
#include <string.h>

enum { XOR, NONE };
enum { STREAM, POLL, RAW };
enum { OUT_HEADING, OUT_FIELD, OUT_ERROR, OUT_FLAG };
enum { SILENT_MS = 3000 }; /* longer than the pauses of the slowest stream: the board was switched on again */

static const double PI = 3.14159265358979323846;

struct micromag3 {
    FL_SERIAL_MEMBERS;
    int mode, checksum;
    int64_t pollfreq;
    double timeout;
};

static const struct fl_parameter parameters[] = {
    FL_SERIAL_PARAMETERS(struct micromag3, "9600"),
    FL_PARAMETER(struct micromag3, mode, .default_value = "stream", .choices = "stream|poll|raw",
                 .summary =
                     "stream: the board sends by itself (go); poll: one sample after the other is asked for (s?); "
                     "raw: the same, uncorrected and without a heading (sr?)"),
    FL_PARAMETER(struct micromag3, pollfreq, .default_value = "8", .min = 0, .max = 16, .unit = "Hz",
                 .summary = "rate of the stream; 0 is one sample in two seconds"),
    FL_PARAMETER(struct micromag3, checksum, .default_value = "xor", .choices = "xor|none",
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
                   .summary =
                       "magnetic field along x, y and z, in the board's units; z is 0 where the board sends none, "
                       "which it does in mode raw only"},
    [OUT_ERROR] = {.name = "error",
                   .type = FL_UINT16,
                   .width = 1,
                   .summary = "the board's error code of the newest sample, 0: none; others make the flag 0"},
    FL_SENSOR_OUTPUTS};

/* --- the conversation: stop the stream, set all that measurements rely on, start. Another user may have stored other
 * settings. A command is sent once the previous one was answered, or was given up. --- */

enum {
    ATTEMPTS = 3, /* at a command, each of 100 ms of silence, */
    SAMPLES = 4,  /* or of as many measurements where the board streams on */
};

/* Manual, pages 13 and 18 to 28. The board sends z in raw mode only; one without such a sensor refuses ez. */
enum stage { STOPPING = 0, FORMAT = 3, Z_AXIS = 7, RATE = 8, RUNNING = 9 };
static const char *const commands[RUNNING] = {
    "h", "uc=d", "sn=m", [FORMAT] = "sdo=t", "ec=e", "ex=e", "ey=e", [Z_AXIS] = "ez=e", [RATE] = "pollfreq="};

struct parser {
    struct micromag3_parser frames;
    uint8_t stage, attempts; /* attempts at the stage's command */
    uint8_t samples;         /* since it was said last */
    uint8_t given_up;        /* the first stage whose command was given up, not logged yet; 0: none */
    uint16_t error;          /* that the board reports, likewise */
    bool sampled;            /* since the last question */
    char reason[96];
};

static bool feed(void *parser, uint8_t byte, void *sample)
{
    struct parser *self = parser;
    struct micromag3_sample read;
    if (!micromag3_feed(&self->frames, byte, &read))
        return false;
    self->sampled = true;
    self->samples++;
    if (self->stage != RUNNING) /* measurements under unknown settings */
        return false;
    self->error = read.error;
    *(struct micromag3_sample *)sample = read;
    return true;
}

static size_t say_command(struct parser *self, const struct micromag3 *micromag3, uint8_t *out, size_t size)
{
    self->samples = 0;
    *self->frames.answer = '\0';
    if (self->stage == RATE)
        return (size_t)snprintf((char *)out, size, "%s%d\r", commands[RATE], (int)micromag3->pollfreq);
    if (self->stage == FORMAT && micromag3->mode == RAW)
        return (size_t)snprintf((char *)out, size, "sdo=r\r");
    return (size_t)snprintf((char *)out, size, "%s\r", commands[self->stage]);
}

/* The board echoes an accepted command; the rate with two digits. */
static bool answered(const struct parser *self, const struct micromag3 *micromag3)
{
    const char *answer = self->frames.answer;
    if (self->stage == RATE)
        return strncmp(answer, commands[RATE], strlen(commands[RATE])) == 0;
    if (self->stage == FORMAT && micromag3->mode == RAW)
        return strcmp(answer, "sdo=r") == 0;
    return strcmp(answer, commands[self->stage]) == 0;
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
        self->attempts = 1;
        return say_command(self, micromag3, out, size);
    }
    if (self->stage == RUNNING) {
        bool ask = micromag3->mode != STREAM && (self->sampled || silent_ms > 0);
        self->sampled = false;
        return ask ? (size_t)snprintf((char *)out, size, "%s", begin[micromag3->mode]) : 0;
    }
    bool taken = answered(self, micromag3);
    if (!taken && silent_ms == 0 && self->samples < SAMPLES)
        return 0;
    if (!taken && self->attempts < ATTEMPTS) {
        self->attempts++;
        return say_command(self, micromag3, out, size);
    }
    if (!taken && !self->given_up && self->stage != STOPPING && self->stage != Z_AXIS)
        self->given_up = self->stage;
    self->stage++;
    self->attempts = 1;
    if (self->stage != RUNNING)
        return say_command(self, micromag3, out, size);
    self->sampled = false;
    return (size_t)snprintf((char *)out, size, "%s", begin[micromag3->mode]);
}

static const char *reason(void *parser, const void *given)
{
    struct parser *self = parser;
    const char *of_record = record_reason(&self->frames.record);
    (void)given;
    if (of_record)
        return of_record;
    if (self->error) {
        snprintf(self->reason, sizeof self->reason, "the board reports error %X: manual, page 11", self->error);
        self->error = 0;
        return self->reason;
    }
    if (self->given_up && self->stage == RUNNING) {
        snprintf(self->reason, sizeof self->reason, "the board does not confirm settings, %s first: check its RxD line",
                 commands[self->given_up]);
        self->given_up = 0;
        return self->reason;
    }
    return NULL;
}

static const struct fl_serial_protocol protocol = {
    .parser_size = sizeof(struct parser),
    .sample_size = sizeof(struct micromag3_sample),
    .feed = feed,
    .send = converse,
    .reason = reason,
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
    .source = "PNI Legacy CommBoard user manual, pages 8 to 28",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct micromag3),
    .state_size = sizeof(struct state),
    .start = start,
    .initialize = initialize,
    .step = step,
    .terminate = terminate,
};
