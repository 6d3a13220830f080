/** oceanserver
 *
 * Reads an OceanServer battery controller on a serial port: charge and time left of the whole, and the state of each
 * battery.
 *
 * Equations:
 *   charge, charges = percent/100;  remaining in s = minutes·60
 *   voltage in V = mV/1000;  current in A = mA/1000;  temperature in K = tenths of K/10
 *
 * Failure: `age` is that of the oldest part: of the whole, of the controller, of each battery that is there. The flag
 * is 0 once that is beyond `timeout`, until all parts have come once, and while the port is closed. Values stay the
 * last good ones. A record with a wrong checksum is dropped. A controller that is silent for 10 s is asked again. A
 * port that is missing or in use is opened again every 100 ms; the journal says once what is wrong.
 */
#include "oceanserver_frame.h"

#include <flotilla/driver.h>
#include <flotilla/sensor.h>

enum {
    OUT_CHARGE,
    OUT_REMAINING,
    OUT_PRESENT,
    OUT_CHARGING,
    OUT_DISCHARGING,
    OUT_EXTERNAL_POWER,
    OUT_POWER_NOT_GOOD,
    OUT_INHIBITED,
    OUT_VOLTAGE,
    OUT_CURRENT,
    OUT_TEMPERATURE,
    OUT_CHARGES,
    OUT_FLAG
};

struct oceanserver {
    FL_SERIAL_MEMBERS;
    int64_t controller;
    double timeout;
};

static const struct fl_parameter parameters[] = {
    FL_SERIAL_PARAMETERS(struct oceanserver, "19200"),
    FL_PARAMETER(struct oceanserver, controller, .default_value = "1", .min = 1, .max = 9,
                 .summary = "number of the controller to read, where several share the port"),
    FL_SENSOR_TIMEOUT(struct oceanserver, "10"),
};

#define MASK(named, said) {.name = (named), .type = FL_UINT8, .width = 1, .summary = "bit mask of batteries " said}
#define EACH(named, in, said)                                                                                          \
    {.name = (named),                                                                                                  \
     .type = FL_DOUBLE,                                                                                                \
     .width = OCEANSERVER_BATTERIES,                                                                                   \
     .unit = (in),                                                                                                     \
     .summary = said " of each battery"}

static const struct fl_port outputs[] = {
    [OUT_CHARGE] = {.name = "charge", .type = FL_DOUBLE, .width = 1, .summary = "average charge, 1 is full"},
    [OUT_REMAINING] = {.name = "remaining",
                       .type = FL_DOUBLE,
                       .width = 1,
                       .unit = "s",
                       .summary =
                           "time until the batteries are empty; 9999 minutes where the controller does not know"},
    [OUT_PRESENT] = MASK("present", "that are there, the first is bit 0"),
    [OUT_CHARGING] = MASK("charging", "that are being charged"),
    [OUT_DISCHARGING] = MASK("discharging", "that feed the robot"),
    [OUT_EXTERNAL_POWER] = MASK("external_power", "with external power"),
    [OUT_POWER_NOT_GOOD] = MASK("power_not_good", "whose power is not good"),
    [OUT_INHIBITED] = MASK("inhibited", "that may not be charged"),
    [OUT_VOLTAGE] = EACH("voltage", "V", "voltage"),
    [OUT_CURRENT] = EACH("current", "A", "current, positive into it,"),
    [OUT_TEMPERATURE] = EACH("temperature", "K", "temperature"),
    [OUT_CHARGES] = EACH("charges", "", "charge, 1 is full,"),
    FL_SENSOR_OUTPUTS};

/* --- the conversation: a space calls up the menu, x in it starts the stream --- */

enum {
    MENU_MS = 200,   /* of silence: the menu is there */
    LOST_MS = 10000, /* of silence: longer than the pauses of a stream, so the controller was switched on again */
};

enum stage { WAKING, ASKED, STREAMING };

/* What is read of a battery. All but the charge, which some controllers leave out, must be there. */
enum { TEMPERATURE, VOLTAGE, CURRENT, CHARGE, REGISTERS };
static const uint8_t registers[REGISTERS] = {
    [TEMPERATURE] = OCEANSERVER_B_TEMPERATURE,
    [VOLTAGE] = OCEANSERVER_B_VOLTAGE,
    [CURRENT] = OCEANSERVER_B_CURRENT,
    [CHARGE] = OCEANSERVER_B_CHARGE,
};

static const struct {
    uint8_t number, output;
} masks[] = {
    {OCEANSERVER_C_PRESENT, OUT_PRESENT}, /* the first one */
    {OCEANSERVER_C_CHARGING, OUT_CHARGING},
    {OCEANSERVER_C_DISCHARGING, OUT_DISCHARGING},
    {OCEANSERVER_C_EXTERNAL_POWER, OUT_EXTERNAL_POWER},
    {OCEANSERVER_C_POWER_NOT_GOOD, OUT_POWER_NOT_GOOD},
    {OCEANSERVER_C_INHIBITED, OUT_INHIBITED},
};
enum { MASKS = sizeof masks / sizeof masks[0] };

struct value {
    int64_t at_ns; /* when it arrived; 0: it has not */
    uint16_t raw;
};

/* The newest of each value: a record has only a part of them, and a whole round of records comes in a burst. */
struct values {
    struct value minutes, percent, masks[MASKS], registers[OCEANSERVER_BATTERIES][REGISTERS];
};

struct parser {
    struct record record;
    struct values values; /* since the port was opened */
    uint8_t stage;
    uint8_t controller; /* the one to read */
};

static void keep(struct value *value, const struct oceanserver_sample *sample, uint8_t number, int64_t now_ns)
{
    uint16_t raw;
    if (oceanserver_value(sample, number, &raw))
        *value = (struct value){now_ns, raw};
}

static void gather(struct parser *self, const struct oceanserver_sample *sample)
{
    const int64_t now_ns = fl_now_ns();
    struct values *values = &self->values;
    uint16_t raw;
    if (sample->kind == OCEANSERVER_SYSTEM) {
        if (oceanserver_value(sample, OCEANSERVER_S_MINUTES, &raw) &&
            oceanserver_value(sample, OCEANSERVER_S_CHARGE, &raw)) {
            keep(&values->minutes, sample, OCEANSERVER_S_MINUTES, now_ns);
            keep(&values->percent, sample, OCEANSERVER_S_CHARGE, now_ns);
        }
    } else if (sample->controller == self->controller && sample->kind == OCEANSERVER_CONTROLLER) {
        for (size_t i = 0; i < MASKS; i++)
            keep(&values->masks[i], sample, masks[i].number, now_ns);
    } else if (sample->controller == self->controller && sample->battery - 1u < OCEANSERVER_BATTERIES) {
        for (size_t i = 0; i < REGISTERS; i++)
            keep(&values->registers[sample->battery - 1u][i], sample, registers[i], now_ns);
    }
}

static bool feed(void *parser, uint8_t byte, void *newest)
{
    struct parser *self = parser;
    struct oceanserver_sample sample;
    bool complete = oceanserver_feed(&self->record, byte, &sample);
    if (complete) {
        gather(self, &sample);
        *(struct values *)newest = self->values;
    }
    /* Before the stream was started, this is the last record that was on the wire when the menu was called up. */
    if (complete && self->stage == ASKED)
        self->stage = STREAMING;
    return complete;
}

static size_t converse(void *parser, const void *given, int silent_ms, uint8_t *out, size_t size)
{
    struct parser *self = parser;
    (void)size;
    self->controller = (uint8_t)((const struct oceanserver *)given)->controller;
    if (silent_ms == FL_SERIAL_OPENED || (self->stage != WAKING && silent_ms > LOST_MS)) {
        self->stage = WAKING;
        *out = ' ';
        return 1;
    }
    if (self->stage == WAKING && silent_ms >= MENU_MS) {
        self->stage = ASKED;
        *out = 'x';
        return 1;
    }
    return 0;
}

static const char *reason(void *parser, const void *given)
{
    (void)given;
    return record_reason(&((struct parser *)parser)->record);
}

static const struct fl_serial_protocol protocol = {
    .parser_size = sizeof(struct parser),
    .sample_size = sizeof(struct values),
    .feed = feed,
    .send = converse,
    .reason = reason,
};

/* --- the block --- */

struct state {
    struct fl_serial *serial;
    struct fl_sensor sensor;
    struct values values; /* also of before the port was opened */
};

static int start(struct fl_block *block)
{
    const struct oceanserver *oceanserver = block->parameters;
    struct state *state = block->state;
    state->serial = fl_serial_start(block, &protocol, FL_SERIAL_SETTINGS(oceanserver), block->parameters);
    return state->serial ? FL_OK : FL_FAILED;
}

static int initialize(struct fl_block *block)
{
    fl_sensor_begin(&((struct state *)block->state)->sensor);
    return FL_OK;
}

/* Whether a value arrived, ever. */
static bool take(struct value *value, const struct value *newest)
{
    if (newest->at_ns)
        *value = *newest;
    return value->at_ns;
}

static void take_battery(struct fl_block *block, struct state *state, const struct values *newest, unsigned battery)
{
    static const struct {
        uint8_t output;
        double parts; /* of the unit */
    } scales[REGISTERS] = {
        [TEMPERATURE] = {OUT_TEMPERATURE, 10},
        [VOLTAGE] = {OUT_VOLTAGE, 1000},
        [CURRENT] = {OUT_CURRENT, 1000},
        [CHARGE] = {OUT_CHARGES, 100},
    };
    for (size_t i = 0; i < REGISTERS; i++) {
        struct value *value = &state->values.registers[battery][i];
        if (take(value, &newest->registers[battery][i]))
            ((double *)block->out[scales[i].output])[battery] =
                (i == CURRENT ? (int16_t)value->raw : value->raw) / scales[i].parts;
    }
}

static void take_all(struct fl_block *block, struct state *state, const struct values *newest)
{
    struct values *values = &state->values;
    if (take(&values->minutes, &newest->minutes))
        FL_OUT(block, OUT_REMAINING, double) = values->minutes.raw * 60.0;
    if (take(&values->percent, &newest->percent))
        FL_OUT(block, OUT_CHARGE, double) = values->percent.raw / 100.0;
    for (size_t i = 0; i < MASKS; i++)
        if (take(&values->masks[i], &newest->masks[i]))
            FL_OUT(block, masks[i].output, uint8_t) = (uint8_t)values->masks[i].raw;
    for (unsigned battery = 0; battery < OCEANSERVER_BATTERIES; battery++)
        take_battery(block, state, newest, battery);
}

static int64_t earlier(int64_t one_ns, int64_t other_ns)
{
    return one_ns < other_ns ? one_ns : other_ns;
}

/* When the oldest part arrived, usually of the battery that fails first; 0 while one is missing. Absent batteries are
 * left out. */
static int64_t oldest(const struct fl_block *block)
{
    const struct state *state = block->state;
    const struct values *values = &state->values;
    int64_t oldest_ns = earlier(values->minutes.at_ns, values->masks[0].at_ns);
    for (unsigned battery = 0; battery < OCEANSERVER_BATTERIES; battery++) {
        if (!(FL_OUT(block, OUT_PRESENT, uint8_t) >> battery & 1))
            continue;
        for (unsigned part = 0; part < REGISTERS; part++)
            if (part != CHARGE || values->registers[battery][part].at_ns)
                oldest_ns = earlier(oldest_ns, values->registers[battery][part].at_ns);
    }
    return oldest_ns;
}

static int step(struct fl_block *block)
{
    const struct oceanserver *oceanserver = block->parameters;
    struct state *state = block->state;
    struct values newest;
    int64_t arrived_ns;
    uint32_t sequence;
    if (fl_serial_newest(state->serial, &newest, &arrived_ns, &sequence)) {
        take_all(block, state, &newest);
        int64_t oldest_ns = oldest(block);
        if (oldest_ns)
            fl_sensor_update(&state->sensor, oldest_ns, sequence);
        else
            fl_sensor_invalidate(&state->sensor);
    }
    fl_sensor_outputs(&state->sensor, block, OUT_FLAG, fl_serial_connected(state->serial), oceanserver->timeout);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    fl_serial_stop(state->serial);
    state->serial = NULL;
}

FL_BLOCK(oceanserver) = {
    .abi = FL_ABI,
    .name = "oceanserver",
    .summary = "OceanServer battery controller on a serial port",
    .source = "OceanServer battery controller, hexadecimal stream; Smart Battery Data Specification 1.1, section 5.1",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct oceanserver),
    .state_size = sizeof(struct state),
    .start = start,
    .initialize = initialize,
    .step = step,
    .terminate = terminate,
};
