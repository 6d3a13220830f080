#include "urg_frame.h"

#include <flotilla/driver.h>
#include <flotilla/sensor.h>
#include <math.h>
#include <stdio.h>

enum { OUT_RANGES, OUT_TIMESTAMP, OUT_FLAG };
enum { STREAM, POLL };
enum { DOUBLE, SINGLE };
enum { NOT_A_NUMBER, ZERO };

struct urg {
    FL_SERIAL_MEMBERS;
    int mode, precision, invalid;
    int64_t first_step, last_step, cluster, skip, characters;
    double min_range, max_range, timeout;
};

static const struct fl_parameter parameters[] = {
    FL_SERIAL_PARAMETERS(struct urg, "115200"),
    FL_PARAMETER(struct urg, mode, .fallback = "stream", .choices = "stream|poll",
                 .summary = "stream: the scanner sends by itself (MD, MS); poll: each scan is asked for (GD, GS)"),
    FL_PARAMETER(struct urg, first_step, .fallback = "44", .min = 0, .max = 9999,
                 .summary = "first direction; the scanner's data sheet says which step looks where"),
    FL_PARAMETER(struct urg, last_step, .fallback = "725", .min = 0, .max = 9999, .summary = "last direction"),
    FL_PARAMETER(struct urg, cluster, .fallback = "1", .min = 1, .max = 99,
                 .summary = "steps that make one point, the shortest of them"),
    FL_PARAMETER(struct urg, skip, .fallback = "0", .min = 0, .max = 9, .summary = "scans left out between two"),
    FL_PARAMETER(struct urg, characters, .fallback = "3", .min = 2, .max = 3,
                 .summary = "of a point on the wire: 2 (up to 4.095 m) or 3"),
    FL_PARAMETER(struct urg, precision, .fallback = "double", .choices = "double|single", .summary = "of `ranges`"),
    FL_PARAMETER(struct urg, invalid, .fallback = "nan", .choices = "nan|zero",
                 .summary = "what stands in `ranges` for a direction without a measurement"),
    FL_PARAMETER(struct urg, min_range, .fallback = "0.02", .min = 0, .max = 262, .unit = "m",
                 .summary = "what is shorter is an error code: 0.02 of a URG-04LX, 0.006 of a UTM-30LX"),
    FL_PARAMETER(struct urg, max_range, .fallback = "5.6", .min = 0, .max = 262, .unit = "m",
                 .summary = "what is longer is no measurement"),
    FL_SENSOR_TIMEOUT(struct urg, "0.3"),
};

static const struct fl_port timestamp = {
    .name = "timestamp",
    .type = FL_DOUBLE,
    .width = 1,
    .unit = "s",
    .summary = "the scanner's own clock at step 0 of the scan; begins anew after 16777.216 s"};

static const struct fl_port status[] = {FL_SENSOR_OUTPUTS};

static struct urg_request request_of(const struct urg *urg)
{
    return (struct urg_request){
        .first = (uint16_t)urg->first_step,
        .last = (uint16_t)urg->last_step,
        .skip = (uint16_t)urg->skip,
        .cluster = (uint8_t)urg->cluster,
        .characters = (uint8_t)urg->characters,
        .stream = urg->mode == STREAM,
    };
}

/* --- the conversation: stop what still streams, the new protocol, the laser, the scans --- */

enum { PATIENCE_MS = 500 }; /* five turns of the scanner: it was switched on anew, or refused */

enum stage { STOPPING, SWITCHING, LIGHTING, SCANNING };

struct parser {
    struct urg_parser frames;
    uint8_t stage;
    uint16_t replied;
    bool scanned; /* since the last question */
};

static bool feed(void *parser, uint8_t byte, void *sample)
{
    struct parser *self = parser;
    bool complete = urg_feed(&self->frames, byte, sample);
    self->scanned |= complete;
    return complete;
}

static size_t say(const char *command, uint8_t *out, size_t size)
{
    return (size_t)snprintf((char *)out, size, "%s\n", command);
}

static size_t converse(void *parser, const void *given, int silent_ms, uint8_t *out, size_t size)
{
    const struct urg_request request = request_of(given);
    struct parser *self = parser;
    if (silent_ms == FL_SERIAL_CLOSING)
        return say("QT", out, size);
    if (silent_ms == FL_SERIAL_OPENED || (self->stage == SCANNING && silent_ms > PATIENCE_MS)) {
        urg_expect(&self->frames, &request);
        self->replied = 0;
        self->stage = STOPPING;
        return say("QT", out, size);
    }
    if (self->stage == SCANNING) {
        bool ask = !request.stream && self->scanned;
        self->scanned = false;
        return ask ? say(self->frames.command, out, size) : 0;
    }
    /* A scanner that knows only the old protocol answers QT in its own way, or not at all. */
    bool replied = self->replied != self->frames.replies;
    self->replied = self->frames.replies;
    if (!replied && silent_ms == 0)
        return 0;
    self->stage++;
    return say(self->stage == SWITCHING ? "SCIP2.0" : self->stage == LIGHTING ? "BM" : self->frames.command, out, size);
}

static const struct fl_serial_protocol protocol = {
    .parser_size = sizeof(struct parser),
    .sample_size = sizeof(struct urg_scan),
    .feed = feed,
    .send = converse,
};

/* --- the block --- */

struct state {
    struct fl_serial *serial;
    struct fl_sensor sensor;
    struct urg_scan scan;
};

static int configure(struct fl_block *block)
{
    const struct urg *urg = block->parameters;
    const struct urg_request request = request_of(urg);
    if (urg->last_step < urg->first_step)
        return fl_fail(block, "last_step lies before first_step");
    if (urg_points(&request) > URG_POINTS)
        return fl_fail(block, "%u points are more than the %d of any scanner", urg_points(&request), URG_POINTS);
    if (urg->max_range <= urg->min_range)
        return fl_fail(block, "max_range is not longer than min_range");
    int failed = fl_add_output(block, (struct fl_port){.name = "ranges",
                                                       .type = urg->precision == DOUBLE ? FL_DOUBLE : FL_SINGLE,
                                                       .width = urg_points(&request),
                                                       .unit = "m",
                                                       .summary = "distance in each direction, from first_step on"});
    failed |= fl_add_output(block, timestamp);
    for (size_t i = 0; i < sizeof status / sizeof status[0]; i++)
        failed |= fl_add_output(block, status[i]);
    return failed;
}

static int start(struct fl_block *block)
{
    const struct urg *urg = block->parameters;
    struct state *state = block->state;
    state->serial = fl_serial_start(block, &protocol, FL_SERIAL_SETTINGS(urg), block->parameters);
    return state->serial ? FL_OK : FL_FAILED;
}

static void set_range(struct fl_block *block, uint32_t point, double range)
{
    const struct urg *urg = block->parameters;
    if (urg->precision == DOUBLE)
        ((double *)block->out[OUT_RANGES])[point] = range;
    else
        ((float *)block->out[OUT_RANGES])[point] = (float)range;
}

static double invalid_range(const struct urg *urg)
{
    return urg->invalid == NOT_A_NUMBER ? NAN : 0;
}

static int initialize(struct fl_block *block)
{
    for (uint32_t point = 0; point < block->out_ports[OUT_RANGES].width; point++)
        set_range(block, point, invalid_range(block->parameters));
    fl_sensor_begin(&((struct state *)block->state)->sensor);
    return FL_OK;
}

static void take_scan(struct fl_block *block, const struct urg_scan *scan)
{
    const struct urg *urg = block->parameters;
    for (uint32_t point = 0; point < scan->count; point++) {
        double range = scan->millimetres[point] / 1000.0;
        bool valid = range >= urg->min_range && range <= urg->max_range;
        set_range(block, point, valid ? range : invalid_range(urg));
    }
    FL_OUT(block, OUT_TIMESTAMP, double) = scan->timestamp / 1000.0;
}

static int step(struct fl_block *block)
{
    const struct urg *urg = block->parameters;
    struct state *state = block->state;
    int64_t arrived_ns;
    uint32_t sequence;
    if (fl_serial_newest(state->serial, &state->scan, &arrived_ns, &sequence)) {
        take_scan(block, &state->scan);
        fl_sensor_update(&state->sensor, arrived_ns, sequence);
    }
    fl_sensor_outputs(&state->sensor, block, OUT_FLAG, fl_serial_connected(state->serial), urg->timeout);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    fl_serial_stop(state->serial);
    state->serial = NULL;
}

FL_BLOCK(urg) = {
    .abi = FL_ABI,
    .name = "urg",
    .summary = "Hokuyo laser scanner that speaks SCIP 2.0 (URG-04LX, UTM-30LX, ...)",
    .source = "Hokuyo communication protocol specification for SCIP 2.0, C-42-03320B",
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct urg),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .initialize = initialize,
    .step = step,
    .terminate = terminate,
};
