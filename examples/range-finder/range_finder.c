/** range-finder
 *
 * Reads a MaxBotix HRXL-MaxSonar-WR ultrasonic range finder (MB73xx) at a serial port, in free run.
 *
 * Equations:
 *   range_m = millimetres/1000
 *
 * Failure: The flag is 0 if no range came for `timeout`, while the port is closed, and if the sensor reports its
 * smallest or its largest value, which `limit` gives: then there is no range. `range_m` stays the last good one.
 */
#include <flotilla/driver.h>
#include <flotilla/sensor.h>

enum { OUT_RANGE, OUT_LIMIT, OUT_FLAG };
enum { DIGITS = 4 };

struct range_finder {
    FL_SERIAL_MEMBERS;
    double min_range, max_range, timeout;
};

static const struct fl_parameter parameters[] = {
    FL_SERIAL_PARAMETERS(struct range_finder, "9600"),
    FL_PARAMETER(struct range_finder, min_range, .flags = FL_TUNABLE, .default_value = "0.3", .min = 0, .max = 10,
                 .unit = "m", .summary = "the sensor reports it for all that is nearer"),
    FL_PARAMETER(struct range_finder, max_range, .flags = FL_TUNABLE, .default_value = "5", .min = 0, .max = 10,
                 .unit = "m", .summary = "the sensor reports it if there is no target: 5, or 9.999 of 10 m models"),
    FL_SENSOR_TIMEOUT(struct range_finder, "0.5"),
};

static const struct fl_port outputs[] = {
    [OUT_RANGE] = {.name = "range_m",
                   .type = FL_DOUBLE,
                   .width = 1,
                   .unit = "m",
                   .summary = "from the sensor's face to the nearest target"},
    [OUT_LIMIT] = {.name = "limit",
                   .type = FL_INT8,
                   .width = 1,
                   .summary = "newest frame: -1 the target is too near, 1 there is none, 0 neither"},
    FL_SENSOR_OUTPUTS};

/* --- the frame: 'R', four digits, carriage return. It has no checksum, so its form has to be exact. --- */

struct parser {
    bool in_frame;
    uint8_t digits;
    uint16_t millimetres;
};

/* Take one byte. An R begins a frame wherever it comes, so the first whole frame after any garbage is read. */
static bool feed(void *state, uint8_t byte, void *sample)
{
    struct parser *parser = state;
    if (byte == 'R') {
        *parser = (struct parser){.in_frame = true};
        return false;
    }
    if (parser->in_frame && byte >= '0' && byte <= '9' && parser->digits < DIGITS) {
        parser->millimetres = (uint16_t)(parser->millimetres * 10 + (byte - '0'));
        parser->digits++;
        return false;
    }
    bool complete = parser->in_frame && byte == '\r' && parser->digits == DIGITS;
    parser->in_frame = false;
    if (complete)
        *(uint16_t *)sample = parser->millimetres;
    return complete;
}

static const struct fl_serial_protocol protocol = {
    .parser_size = sizeof(struct parser),
    .sample_size = sizeof(uint16_t),
    .feed = feed,
};

/* --- the block --- */

struct state {
    struct fl_serial *serial;
    struct fl_sensor sensor;
};

static int start(struct fl_block *block)
{
    const struct range_finder *finder = block->parameters;
    struct state *state = block->state;
    state->serial = fl_serial_start(block, &protocol, FL_SERIAL_SETTINGS(finder), finder);
    return state->serial ? FL_OK : FL_FAILED;
}

static int initialize(struct fl_block *block)
{
    fl_sensor_begin(&((struct state *)block->state)->sensor);
    return FL_OK;
}

static int step(struct fl_block *block)
{
    const struct range_finder *finder = block->parameters;
    struct state *state = block->state;
    uint16_t millimetres;
    int64_t arrived_ns;
    uint32_t sequence;
    if (fl_serial_newest(state->serial, &millimetres, &arrived_ns, &sequence)) {
        double range = millimetres / 1000.0;
        int8_t limit = (int8_t)((range >= finder->max_range) - (range <= finder->min_range));
        FL_OUT(block, OUT_LIMIT, int8_t) = limit;
        if (limit) {
            fl_sensor_invalidate(&state->sensor);
        } else {
            FL_OUT(block, OUT_RANGE, double) = range;
            fl_sensor_update(&state->sensor, arrived_ns, sequence);
        }
    }
    fl_sensor_outputs(&state->sensor, block, OUT_FLAG, fl_serial_connected(state->serial), finder->timeout);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    fl_serial_stop(state->serial);
    state->serial = NULL;
}

FL_BLOCK(range_finder) = {
    .abi = FL_ABI,
    .name = "range-finder",
    .summary = "MaxBotix HRXL-MaxSonar-WR ultrasonic range finder",
    .source = "MaxBotix HRXL-MaxSonar-WR data sheet, PD11500",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct range_finder),
    .state_size = sizeof(struct state),
    .start = start,
    .initialize = initialize,
    .step = step,
    .terminate = terminate,
};
