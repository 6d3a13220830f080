#include "epos2.h"

#include <math.h>
#include <string.h>

/* Predefined connection set (CiA 301, 7.3.3). */
enum {
    COB_NMT = 0x000,
    COB_SYNC = 0x080,
    COB_EMCY = 0x080,
    COB_TPDO1 = 0x180,
    COB_TPDO2 = 0x280,
    COB_TPDO3 = 0x380,
    COB_TPDO4 = 0x480,
    COB_RPDO1 = 0x200,
    COB_RPDO2 = 0x300,
    COB_RPDO3 = 0x400,
    COB_RPDO4 = 0x500,
    COB_SDO_ANSWER = 0x580,
    COB_SDO_REQUEST = 0x600,
    COB_HEARTBEAT = 0x700,
};

enum { NMT_START = 0x01, NMT_RESET_COMMUNICATION = 0x82 };
enum { STATE_BOOT_UP = 0x00, STATE_OPERATIONAL = 0x05 };

/* A COB-ID with bit 31 set is a PDO switched off; bit 30: no remote request, as the drive is shipped. */
#define PDO_OFF  UINT32_C(0xC0000000)
#define TPDO_ON  UINT32_C(0x40000000)
#define RPDO_OFF UINT32_C(0x80000000)
enum { EACH_SYNC = 1, AT_ONCE = 255 }; /* transmission types */

/* Control word 6040 and status word 6041 (CiA 402-2). */
enum {
    DISABLE_VOLTAGE = 0x0000,
    QUICK_STOP = 0x0002,
    SHUTDOWN = 0x0006,
    SWITCH_ON = 0x0007,
    ENABLE_OPERATION = 0x000F,
    NEW_SETPOINT = 0x0010,
    CHANGE_AT_ONCE = 0x0020,
    FAULT_RESET = 0x0080,
};
enum { START_HOMING = 0x0010 };
enum { SETPOINT_ACKNOWLEDGED = 0x1000 };
/* In the mode homing. The last one stays in every mode, as long as the drive knows its position. */
enum { TARGET_REACHED = 0x0400, HOMING_ATTAINED = 0x1000, HOMING_ERROR = 0x2000, REFERENCED = 0x8000 };
enum { MODE_HOMING = 6 };

enum axis {
    NOT_READY,
    SWITCH_ON_DISABLED,
    READY_TO_SWITCH_ON,
    SWITCHED_ON,
    OPERATION_ENABLED,
    QUICK_STOP_ACTIVE,
    FAULT_REACTION,
    FAULT,
};

/* By mode: 6060, and the object of its target with its bits, as a PDO's mapping names them. */
static const struct {
    int8_t mode;
    uint32_t target;
} modes[] = {
    [EPOS2_POSITION] = {-1, 0x20620020},        [EPOS2_VELOCITY] = {-2, 0x206B0020},
    [EPOS2_CURRENT] = {-3, 0x20300010},         [EPOS2_PROFILE_POSITION] = {1, 0x607A0020},
    [EPOS2_PROFILE_VELOCITY] = {3, 0x60FF0020},
};

#define MS INT64_C(1000000)
static const int64_t boot_retry_ns = 1000 * MS, sdo_timeout_ns = 500 * MS, refused_retry_ns = 1000 * MS;
static const int64_t stop_limit_ns = 2000 * MS; /* of a quick stop, before the power is taken off all the same */
static const int64_t reset_interval_ns = 1000 * MS;
static const int64_t search_begin_ns = 200 * MS; /* until then the status word may be that of the search before */
static const double standstill_rpm = 5;

/* --- bytes --- */

static uint32_t get(const uint8_t *bytes, size_t count)
{
    uint32_t value = 0;
    for (size_t i = 0; i < count; i++)
        value |= (uint32_t)bytes[i] << (8 * i);
    return value;
}

static void put(uint8_t *bytes, size_t count, uint32_t value)
{
    for (size_t i = 0; i < count; i++)
        bytes[i] = (uint8_t)(value >> (8 * i));
}

static struct can_frame frame_of(uint32_t id, uint8_t length)
{
    struct can_frame frame = {.can_id = id};
    frame.len = length;
    return frame;
}

static struct can_frame nmt(const struct epos2 *drive, uint8_t command)
{
    struct can_frame frame = frame_of(COB_NMT, 2);
    frame.data[0] = command;
    frame.data[1] = drive->settings.node;
    return frame;
}

/* --- configuration --- */

static void write_object(struct epos2 *drive, uint16_t index, uint8_t sub, uint8_t size, uint32_t value)
{
    if (drive->write_count < EPOS2_WRITES)
        drive->writes[drive->write_count++] = (struct epos2_write){index, sub, size, value};
}

/* A mapping may only be changed while its PDO is off (CiA 301, 7.5.2.36). */
static void map_pdo(struct epos2 *drive, uint16_t index, uint32_t off, uint32_t on, uint8_t transmission,
                    const uint32_t *objects, uint8_t count)
{
    enum { MAPPING = 0x200 }; /* from a PDO's parameters to its mapping: 1400 to 1600, 1800 to 1A00 */
    uint16_t mapping = (uint16_t)(index + MAPPING);
    write_object(drive, index, 1, 4, off);
    write_object(drive, index, 2, 1, transmission);
    write_object(drive, mapping, 0, 1, 0);
    for (uint8_t i = 0; i < count; i++)
        write_object(drive, mapping, (uint8_t)(i + 1), 4, objects[i]);
    write_object(drive, mapping, 0, 1, count);
    write_object(drive, index, 1, 4, on);
}

static void list_homing(struct epos2 *drive)
{
    const struct epos2_settings *set = &drive->settings;
    write_object(drive, 0x6098, 0, 1, (uint8_t)set->homing_method);
    if (set->homing_rpm) {
        write_object(drive, 0x6099, 1, 4, set->homing_rpm);
        write_object(drive, 0x6099, 2, 4, set->homing_rpm);
    }
    if (set->rpm_per_s)
        write_object(drive, 0x609A, 0, 4, set->rpm_per_s);
    if (set->homing_ma)
        write_object(drive, 0x2080, 0, 2, set->homing_ma);
    write_object(drive, 0x607C, 0, 4, (uint32_t)set->homing_offset);
    write_object(drive, 0x2081, 0, 4, 0); /* the position there */
}

static void list_writes(struct epos2 *drive)
{
    const struct epos2_settings *set = &drive->settings;
    const uint32_t command[] = {0x60400010, modes[set->mode].target};
    const uint32_t command_and_mode[] = {0x60400010, modes[set->mode].target, 0x60600008};
    const uint32_t motion[] = {0x60410010, 0x606C0020, 0x60780010};
    const uint32_t mode[] = {0x60410010, 0x60610008};
    const uint32_t position[] = {0x60410010, 0x60640020};
    drive->write_count = drive->write_next = 0;
    write_object(drive, 0x6040, 0, 2, DISABLE_VOLTAGE);
    write_object(drive, 0x6060, 0, 1, (uint8_t)modes[set->mode].mode);
    map_pdo(drive, 0x1400, RPDO_OFF + COB_RPDO1 + set->node, COB_RPDO1 + set->node, AT_ONCE, command, 1);
    /* Switch unused PDOs off: the drive may have stored an identifier that another node uses. TPDO1 would only repeat
     * the status word of the others, and overtake them on the bus. */
    write_object(drive, 0x1401, 1, 4, RPDO_OFF + COB_RPDO2 + set->node);
    write_object(drive, 0x1402, 1, 4, RPDO_OFF + COB_RPDO3 + set->node);
    write_object(drive, 0x1800, 1, 4, PDO_OFF + COB_TPDO1 + set->node);
    map_pdo(drive, 0x1403, RPDO_OFF + COB_RPDO4 + set->node, COB_RPDO4 + set->node, AT_ONCE,
            set->homing_method ? command_and_mode : command, set->homing_method ? 3 : 2);
    map_pdo(drive, 0x1801, PDO_OFF + COB_TPDO2 + set->node, TPDO_ON + COB_TPDO2 + set->node, EACH_SYNC, mode, 2);
    map_pdo(drive, 0x1802, PDO_OFF + COB_TPDO3 + set->node, TPDO_ON + COB_TPDO3 + set->node, EACH_SYNC, position, 2);
    map_pdo(drive, 0x1803, PDO_OFF + COB_TPDO4 + set->node, TPDO_ON + COB_TPDO4 + set->node, EACH_SYNC, motion, 3);
    if (set->max_rpm) {
        write_object(drive, 0x607F, 0, 4, set->max_rpm);
        write_object(drive, 0x6081, 0, 4, set->max_rpm);
    }
    if (set->rpm_per_s) {
        write_object(drive, 0x6083, 0, 4, set->rpm_per_s);
        write_object(drive, 0x6084, 0, 4, set->rpm_per_s);
    }
    if (set->stop_rpm_per_s)
        write_object(drive, 0x6085, 0, 4, set->stop_rpm_per_s);
    if (set->limit_ma)
        write_object(drive, 0x6410, 2, 2, set->limit_ma);
    if (set->homing_method)
        list_homing(drive);
    write_object(drive, 0x6007, 0, 2, 1); /* a lost connection is a fault: it stops, and stays so until reset */
    write_object(drive, 0x1017, 0, 2, (uint32_t)set->heartbeat_ms / EPOS2_HEARTBEATS);
    /* From now on it waits for our heartbeats. */
    write_object(drive, 0x1016, 1, 4, (uint32_t)set->master << 16 | set->heartbeat_ms);
}

static void enter(struct epos2 *drive, enum epos2_phase phase, int64_t now_ns)
{
    if (drive->phase == EPOS2_RUNNING)
        drive->armed = false;
    drive->phase = phase;
    drive->phase_ns = now_ns;
    drive->sdo_waiting = false;
    drive->reset_sent = false;
    drive->status_known = false;
    drive->have_position = false;
    drive->stopping = false;
    drive->setpoint_state = SETPOINT_NONE;
    drive->search_state = SEARCH_NONE;
    drive->mode_display = 0;
    drive->control_word = DISABLE_VOLTAGE;
    drive->status_before = 0x0008; /* a drive that is already in fault did not fail while we had it */
    if (phase == EPOS2_CONFIGURING)
        list_writes(drive);
}

void epos2_begin(struct epos2 *drive, const struct epos2_settings *settings)
{
    memset(drive, 0, sizeof *drive);
    drive->settings = *settings;
    epos2_lose(drive);
    drive->heartbeat_ns = drive->reset_ns = INT64_MIN / 2;
}

void epos2_lose(struct epos2 *drive)
{
    enter(drive, EPOS2_BOOTING, INT64_MIN / 2); /* long ago: the first reset is due */
}

void epos2_identifiers(const struct epos2_settings *settings, uint32_t identifiers[EPOS2_IDENTIFIERS])
{
    static const uint32_t bases[EPOS2_IDENTIFIERS] = {COB_EMCY,  COB_TPDO2,      COB_TPDO3,
                                                      COB_TPDO4, COB_SDO_ANSWER, COB_HEARTBEAT};
    for (size_t i = 0; i < EPOS2_IDENTIFIERS; i++)
        identifiers[i] = bases[i] + settings->node;
}

/* --- reception --- */

static enum axis axis_of(uint16_t status_word)
{
    switch (status_word & 0x004F) {
    case 0x0000:
        return NOT_READY;
    case 0x0040:
        return SWITCH_ON_DISABLED;
    case 0x000F:
        return FAULT_REACTION;
    case 0x0008:
        return FAULT;
    default:
        break;
    }
    switch (status_word & 0x006F) {
    case 0x0021:
        return READY_TO_SWITCH_ON;
    case 0x0023:
        return SWITCHED_ON;
    case 0x0027:
        return OPERATION_ENABLED;
    case 0x0007:
        return QUICK_STOP_ACTIVE;
    default:
        return NOT_READY;
    }
}

static void take_answer(struct epos2 *drive, const uint8_t *data, int64_t at_ns)
{
    enum { DOWNLOADED = 0x60, ABORTED = 0x80 };
    const struct epos2_write *write = &drive->writes[drive->write_next];
    if (drive->phase != EPOS2_CONFIGURING || !drive->sdo_waiting)
        return;
    if (get(data + 1, 2) != write->index || data[3] != write->sub)
        return; /* to a request of another master, or of before a reset */
    if (data[0] == ABORTED) {
        drive->abort_code = get(data + 4, 4);
        drive->abort_write = *write;
        drive->trouble = (struct epos2_trouble){EPOS2_ABORTED, write->index, write->sub, drive->abort_code};
        enter(drive, EPOS2_REFUSED, at_ns);
    } else if (data[0] == DOWNLOADED) {
        drive->sdo_waiting = false;
        drive->write_next++;
    }
}

static void blame(struct epos2 *drive, enum epos2_cause cause)
{
    if (drive->trouble.cause == EPOS2_FINE)
        drive->trouble = (struct epos2_trouble){.cause = cause};
}

/* An error code, or 0: the drive has none any more. */
static void take_emergency(struct epos2 *drive, uint16_t code)
{
    drive->error_code = code;
    if (code)
        drive->trouble = (struct epos2_trouble){.cause = EPOS2_EMERGENCY, .code = code};
    else if (drive->trouble.cause == EPOS2_EMERGENCY)
        drive->trouble.cause = EPOS2_FINE;
}

static void take_status(struct epos2 *drive, const uint8_t *data)
{
    uint16_t status_word = (uint16_t)get(data, 2);
    if (axis_of(drive->status_word) == FAULT && axis_of(status_word) != FAULT)
        take_emergency(drive, 0);
    drive->status_word = status_word;
    drive->status_known = true;
}

static void take_motion(struct epos2 *drive, const uint8_t *data, int64_t at_ns)
{
    const struct epos2_settings *set = &drive->settings;
    take_status(drive, data);
    if (!drive->have_position)
        return; /* not both of the same SYNC */
    drive->have_position = false;
    drive->values = (struct epos2_values){
        .position = drive->counts / set->counts_per_rad,
        .velocity = (int32_t)get(data + 2, 4) / set->rpm_per_rad_s,
        .current = (int16_t)get(data + 6, 2) * 1e-3,
    };
    drive->values_ns = drive->position_ns < at_ns ? drive->position_ns : at_ns;
    drive->sequence++;
}

static void take_heartbeat(struct epos2 *drive, uint8_t state, int64_t at_ns)
{
    drive->received_ns = at_ns;
    if (state == STATE_BOOT_UP) { /* as asked, or its power came back */
        enter(drive, EPOS2_CONFIGURING, at_ns);
    } else if (drive->phase == EPOS2_RUNNING && state != STATE_OPERATIONAL) {
        drive->status_known = false; /* started again by the next advance */
    }
}

void epos2_receive(struct epos2 *drive, const struct can_frame *frame, int64_t at_ns)
{
    const uint8_t *data = frame->data;
    uint32_t node = drive->settings.node;
    switch (frame->can_id - node) { /* frames of other formats differ in their flags */
    case COB_HEARTBEAT:
        if (frame->len == 1)
            take_heartbeat(drive, data[0] & 0x7F, at_ns);
        break;
    case COB_SDO_ANSWER:
        if (frame->len == 8)
            take_answer(drive, data, at_ns);
        break;
    case COB_EMCY:
        if (frame->len == 8)
            take_emergency(drive, (uint16_t)get(data, 2));
        break;
    case COB_TPDO2:
        if (drive->phase == EPOS2_RUNNING && frame->len == 3) {
            take_status(drive, data);
            drive->mode_display = (int8_t)data[2];
        }
        break;
    case COB_TPDO3:
        if (drive->phase == EPOS2_RUNNING && frame->len == 6) {
            take_status(drive, data);
            drive->counts = (int32_t)get(data + 2, 4);
            drive->position_ns = at_ns;
            drive->have_position = true;
        }
        break;
    case COB_TPDO4:
        if (drive->phase == EPOS2_RUNNING && frame->len == 8)
            take_motion(drive, data, at_ns);
        break;
    default:
        break;
    }
}

/* --- the axis --- */

bool epos2_enabled(const struct epos2 *drive)
{
    return drive->phase == EPOS2_RUNNING && drive->status_known && axis_of(drive->status_word) == OPERATION_ENABLED &&
           drive->mode_display == modes[drive->settings.mode].mode;
}

bool epos2_homed(const struct epos2 *drive)
{
    return !drive->settings.homing_method || drive->status_word & REFERENCED;
}

/* Mode to be in now. */
static int8_t wanted_mode(const struct epos2 *drive)
{
    return epos2_homed(drive) ? modes[drive->settings.mode].mode : MODE_HOMING;
}

static int32_t rounded(double value, double limit)
{
    value = value > limit ? limit : value < -limit ? -limit : value;
    return (int32_t)lround(value);
}

/* In the units of the target's object, within its range. */
static int32_t target_of(const struct epos2_settings *set, double target)
{
    switch (set->mode) {
    case EPOS2_POSITION:
    case EPOS2_PROFILE_POSITION:
        return rounded(target * set->counts_per_rad, INT32_MAX);
    case EPOS2_VELOCITY:
    case EPOS2_PROFILE_VELOCITY:
        return rounded(target * set->rpm_per_rad_s, set->max_rpm ? set->max_rpm : INT32_MAX);
    case EPOS2_CURRENT:
    default:
        return rounded(target * 1e3, set->limit_ma && set->limit_ma < INT16_MAX ? set->limit_ma : INT16_MAX);
    }
}

/* A new position is offered by a rising edge. It stays until the drive has acknowledged it, and the edge falls before
 * the next is offered: the drive looks at the target at the edge only. */
static uint16_t profile_position_word(struct epos2 *drive, int32_t *target)
{
    bool acknowledged = drive->status_word & SETPOINT_ACKNOWLEDGED;
    bool offered = drive->setpoint_state == SETPOINT_OFFERED;
    bool taken = drive->setpoint_state == SETPOINT_TAKEN;
    if (offered && acknowledged) {
        drive->setpoint_state = SETPOINT_TAKEN;
    } else if (!offered && !acknowledged && !(taken && *target == drive->setpoint)) {
        drive->setpoint_state = SETPOINT_OFFERED;
        drive->setpoint = *target;
    }
    *target = drive->setpoint;
    return ENABLE_OPERATION | (drive->setpoint_state == SETPOINT_OFFERED ? NEW_SETPOINT | CHANGE_AT_ONCE : 0);
}

/* Begin a search by a rising edge, and hold the bit while it lasts, as its fall would end it. */
static uint16_t homing_word(struct epos2 *drive, int64_t now_ns)
{
    if (drive->search_state == SEARCH_NONE) {
        drive->search_state = SEARCH_BEGUN;
        drive->search_ns = now_ns;
        return ENABLE_OPERATION;
    }
    int64_t lasts_ns = now_ns - drive->search_ns;
    bool failed = drive->status_word & HOMING_ERROR && lasts_ns > search_begin_ns;
    if (failed || lasts_ns > drive->settings.homing_ns) {
        drive->search_state = SEARCH_FAILED;
        drive->armed = false;
        drive->trouble = (struct epos2_trouble){.cause = EPOS2_NOT_HOMED, .code = failed ? 0 : 1};
        return QUICK_STOP;
    }
    return ENABLE_OPERATION | START_HOMING;
}

static uint16_t stop_word(struct epos2 *drive, enum axis axis, int64_t now_ns)
{
    if (axis != OPERATION_ENABLED && axis != QUICK_STOP_ACTIVE) {
        drive->stopping = false;
        return DISABLE_VOLTAGE;
    }
    if (!drive->stopping) {
        drive->stopping = true;
        drive->stop_ns = now_ns;
    }
    bool still =
        axis == QUICK_STOP_ACTIVE && fabs(drive->values.velocity * drive->settings.rpm_per_rad_s) < standstill_rpm;
    return still || now_ns - drive->stop_ns > stop_limit_ns ? DISABLE_VOLTAGE : QUICK_STOP;
}

/* Bit 7 acts on its rising edge, so it is low in every other frame. */
static uint16_t fault_word(struct epos2 *drive, int64_t now_ns)
{
    if (drive->settings.automatic_reset && now_ns - drive->reset_ns >= reset_interval_ns)
        drive->reset_wanted = true;
    if (!drive->reset_wanted)
        return DISABLE_VOLTAGE;
    drive->reset_wanted = false;
    drive->reset_ns = now_ns;
    return FAULT_RESET;
}

static bool is_fault(enum axis axis)
{
    return axis == FAULT || axis == FAULT_REACTION;
}

/* It has a fault now, or left operation while it was commanded to stay there. */
static bool has_failed(const struct epos2 *drive)
{
    enum axis before = axis_of(drive->status_before), axis = axis_of(drive->status_word);
    bool left = before == OPERATION_ENABLED && axis != OPERATION_ENABLED;
    return (is_fault(axis) && !is_fault(before)) ||
           (left && (drive->control_word & ENABLE_OPERATION) == ENABLE_OPERATION);
}

/* Whether the motor may be on, by what `enable` has done. */
static bool is_armed(struct epos2 *drive, bool enable)
{
    bool there = drive->phase == EPOS2_RUNNING && drive->status_known;
    bool edge = enable && !drive->was_enabled && (there || !drive->contacted);
    if (there && has_failed(drive))
        drive->armed = false;
    drive->was_enabled = enable;
    drive->armed = enable && (drive->armed || edge);
    drive->reset_wanted = enable && (drive->reset_wanted || edge);
    if (edge || (!enable && drive->search_state != SEARCH_FAILED))
        drive->search_state = SEARCH_NONE;
    if (drive->search_state == SEARCH_FAILED)
        drive->armed = false;
    return drive->armed || (enable && drive->settings.automatic_restart && drive->search_state != SEARCH_FAILED);
}

/* The one word that brings the axis a step nearer to what is wanted: each state is acknowledged by the status word
 * before the next is asked for. */
static uint16_t control_word(struct epos2 *drive, int64_t now_ns, bool commanded, bool armed, int32_t *target)
{
    enum axis axis = axis_of(drive->status_word);
    if (axis != OPERATION_ENABLED)
        drive->setpoint_state = SETPOINT_NONE;
    if (axis == FAULT)
        return commanded ? fault_word(drive, now_ns) : DISABLE_VOLTAGE;
    if (axis != FAULT_REACTION)
        drive->reset_wanted = false;
    if (!commanded || !armed)
        return stop_word(drive, axis, now_ns);
    drive->stopping = false;
    if (axis == OPERATION_ENABLED && !epos2_homed(drive) && drive->mode_display == MODE_HOMING)
        return homing_word(drive, now_ns);
    if (drive->trouble.cause == EPOS2_NOT_HOMED && epos2_homed(drive))
        drive->trouble.cause = EPOS2_FINE;
    if (axis == OPERATION_ENABLED && drive->settings.homing_method && drive->mode_display == MODE_HOMING)
        return ENABLE_OPERATION; /* homed, and about to be in the other mode; it stays where it is */
    if (axis != OPERATION_ENABLED && drive->search_state == SEARCH_BEGUN)
        drive->search_state = SEARCH_NONE;
    if (drive->mode_display != wanted_mode(drive))
        return SHUTDOWN;
    switch (axis) {
    case SWITCH_ON_DISABLED:
        return SHUTDOWN;
    case READY_TO_SWITCH_ON:
        return SWITCH_ON;
    case SWITCHED_ON:
        return ENABLE_OPERATION;
    case OPERATION_ENABLED:
        return drive->settings.mode == EPOS2_PROFILE_POSITION ? profile_position_word(drive, target) : ENABLE_OPERATION;
    case QUICK_STOP_ACTIVE: /* left by way of switch on disabled */
    default:
        return DISABLE_VOLTAGE;
    }
}

static struct can_frame command_frame(const struct epos2 *drive, uint16_t word, int32_t target)
{
    uint8_t size = (uint8_t)((modes[drive->settings.mode].target & 0xFF) / 8);
    bool homing = drive->settings.homing_method;
    struct can_frame frame = frame_of(COB_RPDO4 + drive->settings.node, (uint8_t)(2 + size + homing));
    put(frame.data, 2, word);
    put(frame.data + 2, size, (uint32_t)target);
    if (homing)
        frame.data[2 + size] = (uint8_t)wanted_mode(drive);
    return frame;
}

/* What holds the motor where it is, in the mode asked for. */
static int32_t idle_target(const struct epos2 *drive)
{
    bool position = drive->settings.mode == EPOS2_POSITION || drive->settings.mode == EPOS2_PROFILE_POSITION;
    return position ? drive->counts : 0;
}

/* --- transmission --- */

static struct can_frame sdo(const struct epos2 *drive, const struct epos2_write *write)
{
    struct can_frame frame = frame_of(COB_SDO_REQUEST + drive->settings.node, 8);
    frame.data[0] = (uint8_t)(0x23 | (4 - write->size) << 2); /* expedited download of `size` bytes */
    put(frame.data + 1, 2, write->index);
    frame.data[3] = write->sub;
    put(frame.data + 4, write->size, write->value);
    return frame;
}

static bool boot(struct epos2 *drive, int64_t now_ns, struct can_frame *out)
{
    if (now_ns - drive->phase_ns < boot_retry_ns)
        return false;
    if (drive->reset_sent)
        blame(drive, EPOS2_NO_ANSWER);
    drive->reset_sent = true;
    drive->phase_ns = now_ns;
    *out = nmt(drive, NMT_RESET_COMMUNICATION);
    return true;
}

static bool configure(struct epos2 *drive, int64_t now_ns, struct can_frame *out)
{
    if (drive->sdo_waiting) {
        if (now_ns - drive->sdo_ns > sdo_timeout_ns) { /* gone, or it lost a frame: from the beginning */
            blame(drive, EPOS2_NO_ANSWER);
            enter(drive, EPOS2_BOOTING, now_ns - boot_retry_ns);
        }
        return false;
    }
    *out = sdo(drive, &drive->writes[drive->write_next]);
    drive->sdo_waiting = true;
    drive->sdo_ns = now_ns;
    return true;
}

static size_t run(struct epos2 *drive, int64_t now_ns, const struct epos2_command *command, bool armed,
                  struct can_frame *out)
{
    size_t count = 0;
    if (!drive->status_known) {
        out[count++] = nmt(drive, NMT_START);
    } else {
        bool commanded = command->enable && isfinite(command->target);
        int32_t target = commanded ? target_of(&drive->settings, command->target) : idle_target(drive);
        uint16_t word = control_word(drive, now_ns, commanded, armed, &target);
        drive->control_word = word;
        drive->status_before = drive->status_word;
        bool follows = drive->mode_display == modes[drive->settings.mode].mode;
        bool operating = (word & ENABLE_OPERATION) == ENABLE_OPERATION && follows;
        out[count++] = command_frame(drive, word, operating ? target : idle_target(drive));
    }
    return count;
}

size_t epos2_advance(struct epos2 *drive, int64_t now_ns, const struct epos2_command *command,
                     struct can_frame out[EPOS2_FRAMES])
{
    int64_t silence_ns = drive->settings.heartbeat_ms * MS;
    size_t count = 0;
    if (drive->phase == EPOS2_CONFIGURING && drive->write_next == drive->write_count) {
        enter(drive, EPOS2_RUNNING, now_ns);
        drive->received_ns = now_ns;
        /* The drive monitors our heartbeat only after it has received one (CiA 301, object 1016), so send it before the
         * motor may move. */
        drive->heartbeat_ns = INT64_MIN / 2;
        drive->contacted = true;
        drive->abort_code = 0;
        if (drive->trouble.cause != EPOS2_EMERGENCY)
            drive->trouble.cause = EPOS2_FINE;
    }
    if (drive->phase == EPOS2_RUNNING && now_ns - drive->received_ns > silence_ns) {
        blame(drive, EPOS2_NO_HEARTBEAT);
        enter(drive, EPOS2_BOOTING, now_ns - boot_retry_ns);
    }
    if (drive->phase == EPOS2_REFUSED && now_ns - drive->phase_ns >= refused_retry_ns)
        enter(drive, EPOS2_BOOTING, now_ns - boot_retry_ns);
    /* The next call would be too late. */
    if (now_ns + (now_ns - drive->advanced_ns) - drive->heartbeat_ns > silence_ns / EPOS2_HEARTBEATS) {
        drive->heartbeat_ns = now_ns;
        out[count] = frame_of(COB_HEARTBEAT + drive->settings.master, 1);
        out[count++].data[0] = STATE_OPERATIONAL;
    }
    drive->advanced_ns = now_ns;
    bool armed = is_armed(drive, command->enable);
    if (drive->phase == EPOS2_BOOTING)
        count += boot(drive, now_ns, &out[count]);
    else if (drive->phase == EPOS2_CONFIGURING)
        count += configure(drive, now_ns, &out[count]);
    else if (drive->phase == EPOS2_RUNNING)
        count += run(drive, now_ns, command, armed, &out[count]);
    if (command->sync)
        out[count++] = frame_of(COB_SYNC, 0);
    return count;
}

/* By every way there is. */
static size_t command_all(const struct epos2 *drive, uint16_t word, struct can_frame out[EPOS2_FRAMES])
{
    const struct epos2_write write = {0x6040, 0, 2, word};
    out[0] = command_frame(drive, word, idle_target(drive));
    out[1] = frame_of(COB_RPDO1 + drive->settings.node, 2);
    put(out[1].data, 2, word);
    out[2] = sdo(drive, &write);
    return 3;
}

size_t epos2_quick_stop(const struct epos2 *drive, struct can_frame out[EPOS2_FRAMES])
{
    return command_all(drive, QUICK_STOP, out);
}

bool epos2_powered(const struct epos2 *drive)
{
    enum axis axis = axis_of(drive->status_word);
    return drive->phase == EPOS2_RUNNING &&
           (!drive->status_known || axis == OPERATION_ENABLED || axis == QUICK_STOP_ACTIVE || axis == FAULT_REACTION);
}

size_t epos2_shutdown(const struct epos2 *drive, struct can_frame out[EPOS2_FRAMES])
{
    size_t count = command_all(drive, DISABLE_VOLTAGE, out);
    out[count++] = nmt(drive, NMT_RESET_COMMUNICATION);
    return count;
}
