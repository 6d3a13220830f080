/** urg
 *
 * Reads scans of a Hokuyo laser scanner that speaks SCIP 2.0. The block finds a scanner that talks at another rate,
 * sets it to `baud`, and switches its laser on.
 *
 * Equations:
 *   range in m = millimetres/1000; −∞ where something is too near to be measured; `invalid` where nothing was measured
 *   nothing was measured: millimetres/1000 > max_range, or an error code, which is less than min_range and 20, or 6
 *   where min_range is below 0.02 m
 *   too near: less than min_range but no error code, or the code 18 of 20, or the codes 2 and 4 of 6
 *   `invalid: zero` gives 0 for both
 *
 * Failure: The flag is 0 once no scan came for `timeout`, and while the port is closed. While the flag is 0 the values
 * stay the last good ones, and `age` grows. A scan with a wrong checksum or length is dropped. A scanner that falls
 * silent is begun again. A port that is missing or in use is opened again every 100 ms; the journal says once what is
 * wrong.
 */
#include "urg_frame.h"

#include <flotilla/driver.h>
#include <flotilla/sensor.h>
#include <inttypes.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

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
    FL_PARAMETER(struct urg, mode, .default_value = "stream", .choices = "stream|poll",
                 .summary = "stream: the scanner sends by itself (MD, MS); poll: each scan is asked for (GD, GS)"),
    FL_PARAMETER(struct urg, first_step, .default_value = "44", .min = 0, .max = 9999,
                 .summary = "first direction; the scanner's data sheet says which step looks where"),
    FL_PARAMETER(struct urg, last_step, .default_value = "725", .min = 0, .max = 9999, .summary = "last direction"),
    FL_PARAMETER(struct urg, cluster, .default_value = "1", .min = 1, .max = 99,
                 .summary = "steps that make one point, the shortest of them"),
    FL_PARAMETER(struct urg, skip, .default_value = "0", .min = 0, .max = 9,
                 .summary = "scans left out between two; `timeout` has to be longer than the pause"),
    FL_PARAMETER(struct urg, characters, .default_value = "3", .min = 2, .max = 3,
                 .summary = "of a point on the wire: 2 (up to 4.095 m) or 3"),
    FL_PARAMETER(struct urg, precision, .default_value = "double", .choices = "double|single",
                 .summary = "of `ranges`"),
    FL_PARAMETER(struct urg, invalid, .default_value = "nan", .choices = "nan|zero",
                 .summary = "value in `ranges` of a direction where nothing was measured"),
    FL_PARAMETER(struct urg, min_range, .default_value = "0.02", .min = 0, .max = 262, .unit = "m",
                 .summary = "shorter values are error codes, or something too near: 0.02 for a URG-04LX, 0.006 for a "
                            "UTM-30LX"),
    FL_PARAMETER(struct urg, max_range, .default_value = "5.6", .min = 0, .max = 262, .unit = "m",
                 .summary = "longer values are not measurements"),
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

/* --- the conversation: find the rate, stop what still streams, the new protocol, the laser, the scans --- */

enum {
    TURN_MS = 100,   /* of the slowest scanners, 600 rpm */
    SPARE_TURNS = 4, /* turns after which a late scan will not come any more: the scanner was switched on again */
    ANSWER_MS = 150, /* of silence, until a scanner that did not answer is taken for absent; twice and four times as
                        long when it answered at no rate */
    LONGER = 2,      /* doublings of it */
    BUSY_MS = 2000,  /* the same while bytes arrive: a scan on its way takes a second at 19,200 Bd */
    SETTLE_MS = 200, /* until a scanner has changed its rate; urg_library waits 150 ms */
    REFUSED_MS = 1000,
    REASON_TEXT = 128,
};

/* Rates to try after that of the parameter, which is 0 here. RS-232 scanners are shipped with the first; order as in
 * urg_library. */
static const int64_t bauds[] = {0, 19200, 57600, 115200, 250000, 500000, 750000, 38400};

/* The last command. WAITING: none, for a while. */
enum stage { WAITING, QUITTING, LEAVING, RESETTING, SWITCHING, SPEEDING, LIGHTING, SCANNING };

struct parser {
    struct urg_parser frames;
    const struct urg *urg;
    uint8_t stage, rate, rounds; /* rate: index in `bauds`; rounds: of all rates without an answer */
    uint8_t refusals;            /* of QT */
    bool slower;                 /* it refuses the parameter's rate */
    bool scanned;                /* since the last question */
    bool replied;                /* likewise, by this: */
    struct urg_reply answer;
    int64_t asked_ns;
    int wait_ms;
    char asked[URG_COMMAND + 1];
    bool wrong; /* since the last call of take_reason */
    char reason[REASON_TEXT];
};

__attribute__((format(printf, 2, 3))) static void complain(struct parser *self, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(self->reason, sizeof self->reason, format, arguments);
    va_end(arguments);
    self->wrong = true;
}

static void judge(struct parser *self, const struct urg_reply *reply)
{
    const char *meaning = urg_meaning(reply);
    if ((reply->scan_lost || !*reply->status) && !self->wrong)
        complain(self, "wrong checksum or length in an answer: check the cable");
    else if (*reply->status && meaning)
        complain(self, "the scanner answers %.2s by status %s: %s", reply->echo, reply->status, meaning);
}

static bool feed(void *parser, uint8_t byte, void *sample)
{
    struct parser *self = parser;
    uint16_t replies = self->frames.replies;
    bool complete = urg_feed(&self->frames, byte, sample);
    self->scanned |= complete;
    if (self->frames.replies == replies || strcmp(self->frames.reply.echo, self->asked) != 0)
        return complete;
    self->replied = true;
    self->answer = self->frames.reply;
    if (self->stage == LIGHTING || self->stage == SCANNING)
        judge(self, &self->answer);
    return complete;
}

static int64_t baud_of(const void *parser)
{
    return bauds[((const struct parser *)parser)->rate];
}

static const char *take_reason(void *parser, const void *given)
{
    (void)given;
    struct parser *self = parser;
    bool wrong = self->wrong;
    self->wrong = false;
    return wrong ? self->reason : NULL;
}

static size_t say(struct parser *self, enum stage stage, uint8_t *out, size_t size)
{
    static const char *const commands[] = {
        [QUITTING] = "QT", [LEAVING] = "TM2", [RESETTING] = "RS", [SWITCHING] = "SCIP2.0", [LIGHTING] = "BM",
    };
    self->stage = (uint8_t)stage;
    self->asked_ns = fl_now_ns();
    self->scanned = self->replied = false;
    if (stage == SCANNING)
        memcpy(self->asked, self->frames.command, sizeof self->asked);
    else if (stage == SPEEDING)
        snprintf(self->asked, sizeof self->asked, "SS%06u", (unsigned)self->urg->baud % 1000000u);
    else
        snprintf(self->asked, sizeof self->asked, "%s", stage == WAITING ? "" : commands[stage]);
    /* An empty line ends half a command that the scanner may have received before, and is not answered. */
    return stage == WAITING ? 0
                            : (size_t)snprintf((char *)out, size, "%s%s\n", stage == QUITTING ? "\n" : "", self->asked);
}

/* Pause, then begin again at the rate of the parameter. The laser is off. */
static size_t pause_for(struct parser *self, int wait_ms, uint8_t *out, size_t size)
{
    self->wait_ms = wait_ms;
    self->rate = 0;
    return say(self, WAITING, out, size);
}

static size_t begin(struct parser *self, unsigned rate, uint8_t *out, size_t size)
{
    const struct urg_request request = request_of(self->urg);
    urg_expect(&self->frames, &request);
    self->refusals = 0;
    self->rate = (uint8_t)rate;
    return say(self, QUITTING, out, size);
}

static size_t try_next_rate(struct parser *self, uint8_t *out, size_t size)
{
    unsigned rate = self->rate;
    do {
        rate = (rate + 1) % (sizeof bauds / sizeof bauds[0]);
    } while (bauds[rate] == self->urg->baud);
    if (!rate && self->rounds < LONGER)
        self->rounds++;
    return begin(self, rate, out, size);
}

/* The scanner stopped and speaks SCIP 2.0. The laser is switched on last: until then nothing has to be switched off. */
static size_t go_on(struct parser *self, uint8_t *out, size_t size)
{
    self->rounds = 0;
    return say(self, self->rate && !self->slower ? SPEEDING : LIGHTING, out, size);
}

static size_t refused_to_quit(struct parser *self, const struct urg_reply *reply, uint8_t *out, size_t size)
{
    self->refusals++;
    if (!*reply->status) {
        judge(self, reply);
        return say(self, QUITTING, out, size);
    }
    if (!reply->status[1]) /* SCIP 1.1 */
        return say(self, SWITCHING, out, size);
    if (self->refusals == 1) /* it is in time adjustment mode, and accepts nothing else */
        return say(self, LEAVING, out, size);
    if (self->refusals == 2)
        return say(self, RESETTING, out, size);
    judge(self, reply);
    return pause_for(self, REFUSED_MS, out, size);
}

static size_t answered(struct parser *self, uint8_t *out, size_t size)
{
    const struct urg_reply *reply = &self->answer;
    bool well = *reply->status && !urg_meaning(reply);
    switch ((enum stage)self->stage) {
    case QUITTING:
        return well && reply->status[1] ? go_on(self, out, size) : refused_to_quit(self, reply, out, size);
    case LEAVING:
    case RESETTING:
        return say(self, QUITTING, out, size);
    case SWITCHING:
        if (well || reply->status[1])
            return go_on(self, out, size);
        complain(self, "the scanner speaks SCIP 1.1 and refuses SCIP2.0: its firmware is older than 3.0");
        return pause_for(self, REFUSED_MS, out, size);
    case SPEEDING:
        if (well || strcmp(reply->status, "03") == 0)
            return pause_for(self, SETTLE_MS, out, size);
        if (!*reply->status)
            return begin(self, 0, out, size);
        self->slower = true;
        complain(self, "the scanner has %" PRId64 " Bd, and answers %s by status %s: set `baud` to that",
                 bauds[self->rate], self->asked, reply->status);
        return say(self, LIGHTING, out, size);
    case LIGHTING:
        return say(self, SCANNING, out, size);
    case WAITING:
    case SCANNING:
        break;
    }
    return 0;
}

static size_t go_on_scanning(struct parser *self, int silent_ms, uint8_t *out, size_t size)
{
    const struct urg *urg = self->urg;
    bool streams = urg->mode == STREAM;
    /* Stay at the present rate, so that the laser is switched off if it is still on. */
    if (silent_ms > TURN_MS * (SPARE_TURNS + 1 + (streams ? (int)urg->skip : 0)))
        return begin(self, self->rate, out, size);
    bool ask = !streams && (self->scanned || (self->replied && self->answer.scan_lost));
    return ask ? say(self, SCANNING, out, size) : 0;
}

static size_t converse(void *parser, const void *given, int silent_ms, uint8_t *out, size_t size)
{
    struct parser *self = parser;
    self->urg = given;
    if (silent_ms == FL_SERIAL_CLOSING)
        return say(self, QUITTING, out, size);
    if (silent_ms == FL_SERIAL_OPENED)
        return begin(self, 0, out, size);
    int64_t asked_ms = (fl_now_ns() - self->asked_ns) / 1000000;
    if (asked_ms < silent_ms)
        silent_ms = (int)asked_ms;
    if (self->stage == SCANNING)
        return go_on_scanning(self, silent_ms, out, size);
    if (self->stage == WAITING)
        return asked_ms > self->wait_ms ? begin(self, 0, out, size) : 0;
    if (self->replied)
        return answered(self, out, size);
    if (silent_ms < ANSWER_MS << self->rounds && asked_ms < BUSY_MS)
        return 0;
    if (self->stage == QUITTING)
        return try_next_rate(self, out, size);
    return begin(self, self->stage == SPEEDING ? 0 : self->rate, out, size);
}

static const struct fl_serial_protocol protocol = {
    .parser_size = sizeof(struct parser),
    .sample_size = sizeof(struct urg_scan),
    .feed = feed,
    .send = converse,
    .baud = baud_of,
    .reason = take_reason,
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

/* The error codes of the scanner: the UTM-30LX's, or those of the URG-04LX, UBG-04LX and UHG-08LX. */
static const struct codes {
    double min_range; /* m, from which on these are meant */
    uint32_t count;
    uint32_t near; /* a bit for each code by which something is there that is too near, or reflects too much */
} codes[] = {{0.02, 20, 1u << 18}, {0, 6, 1u << 2 | 1u << 4}};

/* Something is there, and it is too near to be measured. */
static bool too_near(const struct urg *urg, uint32_t millimetres)
{
    const struct codes *of = &codes[urg->min_range < codes[0].min_range];
    return millimetres < of->count ? of->near >> millimetres & 1 : millimetres / 1000.0 < urg->min_range;
}

static double range_of(const struct urg *urg, uint32_t millimetres)
{
    double range = millimetres / 1000.0;
    if (range >= urg->min_range && range <= urg->max_range)
        return range;
    return urg->invalid == NOT_A_NUMBER && too_near(urg, millimetres) ? (double)-INFINITY : invalid_range(urg);
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
    for (uint32_t point = 0; point < scan->count; point++)
        set_range(block, point, range_of(urg, scan->millimetres[point]));
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
    .summary =
        "Hokuyo laser scanner that speaks SCIP 2.0 (URG-04LX, UTM-30LX, ...); a scanner at another rate is found, "
        "and set to `baud`",
    .source = "Hokuyo communication protocol specification for SCIP 2.0, C-42-03320B; REP 117: too near is −∞",
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct urg),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .initialize = initialize,
    .step = step,
    .terminate = terminate,
};
