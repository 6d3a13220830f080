#include "epos2_drive.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { READ_ONLY = 1, INTO_RPDO = 2, INTO_TPDO = 4 };
enum { HOMING = 6 };
enum { BOOTING = 0x00, STOPPED = 0x04, OPERATIONAL = 0x05, PRE_OPERATIONAL = 0x7F };

/* Abort codes, CiA 301, 7.2.4.3.17. */
#define BAD_COMMAND  UINT32_C(0x05040001)
#define IS_READ_ONLY UINT32_C(0x06010002)
#define NO_OBJECT    UINT32_C(0x06020000)
#define NOT_MAPPABLE UINT32_C(0x06040041)
#define PDO_TOO_LONG UINT32_C(0x06040042)
#define WRONG_LENGTH UINT32_C(0x06070010)
#define NO_SUB_INDEX UINT32_C(0x06090011)
#define OUT_OF_RANGE UINT32_C(0x06090030)
#define WRONG_STATE  UINT32_C(0x08000022)
#define PDO_OFF      UINT32_C(0x80000000)
#define MILLISECOND  INT64_C(1000000)

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

static void emit(struct drive *drive, uint32_t id, const uint8_t *data, uint8_t length)
{
    struct can_frame frame = {.can_id = id};
    if (drive->out_count == DRIVE_OUT) {
        drive->dropped++;
        return;
    }
    frame.len = length;
    memcpy(frame.data, data, length);
    drive->out[drive->out_count++] = frame;
}

/* --- objects --- */

static struct drive_entry *find(struct drive *drive, uint32_t index, uint32_t sub)
{
    for (size_t i = 0; i < drive->entries; i++)
        if (drive->entry[i].index == index && drive->entry[i].sub == sub)
            return &drive->entry[i];
    return NULL;
}

/* Of an object that is there. */
static uint32_t value_of(struct drive *drive, uint32_t index, uint32_t sub)
{
    return find(drive, index, sub)->value;
}

static void add(struct drive *drive, uint32_t index, uint32_t sub, uint8_t size, uint8_t flags, uint32_t value)
{
    drive->entry[drive->entries++] =
        (struct drive_entry){(uint16_t)index, (uint8_t)sub, size, flags, value}; /* fewer than DRIVE_ENTRIES in all */
}

static void add_pdos(struct drive *drive)
{
    static const uint32_t second[2][4] = {{0, 0x60600008, 0x607A0020, 0x60FF0020},
                                          {0, 0x60610008, 0x60640020, 0x606C0020}};
    for (uint32_t n = 0; n < 4; n++) {
        uint32_t off = n ? UINT32_C(0xC0000000) : UINT32_C(0x40000000);
        add(drive, 0x1400 + n, 0, 1, READ_ONLY, 2);
        add(drive, 0x1400 + n, 1, 4, 0, 0x200 + 0x100 * n + drive->node);
        add(drive, 0x1400 + n, 2, 1, 0, 255);
        add(drive, 0x1800 + n, 0, 1, READ_ONLY, 3);
        add(drive, 0x1800 + n, 1, 4, 0, off + 0x180 + 0x100 * n + drive->node);
        add(drive, 0x1800 + n, 2, 1, 0, 255);
        add(drive, 0x1800 + n, 3, 2, 0, 10);
        for (uint32_t kind = 0; kind < 2; kind++) {
            uint32_t mapping = (kind ? 0x1A00 : 0x1600) + n;
            add(drive, mapping, 0, 1, 0, second[kind][n] ? 2 : 1);
            for (uint32_t sub = 1; sub <= 8; sub++)
                add(drive, mapping, sub, 4, 0,
                    sub == 1   ? (kind ? UINT32_C(0x60410010) : UINT32_C(0x60400010))
                    : sub == 2 ? second[kind][n]
                               : 0);
        }
    }
}

static void add_objects(struct drive *drive)
{
    drive->entries = 0;
    add(drive, 0x1000, 0, 4, READ_ONLY, 0x00020192);
    add(drive, 0x1001, 0, 1, READ_ONLY, 0);
    add(drive, 0x1005, 0, 4, 0, 0x80);
    add(drive, 0x1014, 0, 4, 0, 0x80u + drive->node);
    add(drive, 0x1016, 0, 1, READ_ONLY, 2);
    add(drive, 0x1016, 1, 4, 0, 0);
    add(drive, 0x1016, 2, 4, 0, 0);
    add(drive, 0x1017, 0, 2, 0, 0);
    add(drive, 0x1018, 0, 1, READ_ONLY, 4);
    add(drive, 0x1018, 1, 4, READ_ONLY, 0xFB);
    add_pdos(drive);
    add(drive, 0x6007, 0, 2, 0, 1);
    add(drive, 0x6040, 0, 2, INTO_RPDO, 0);
    add(drive, 0x6041, 0, 2, READ_ONLY | INTO_TPDO, 0);
    add(drive, 0x6060, 0, 1, INTO_RPDO, 0xFE);
    add(drive, 0x6061, 0, 1, READ_ONLY | INTO_TPDO, 0xFE);
    add(drive, 0x6064, 0, 4, READ_ONLY | INTO_TPDO, 0);
    add(drive, 0x606C, 0, 4, READ_ONLY | INTO_TPDO, 0);
    add(drive, 0x6078, 0, 2, READ_ONLY | INTO_TPDO, 0);
    add(drive, 0x607F, 0, 4, 0, 25000);
    add(drive, 0x6081, 0, 4, 0, 1000);
    add(drive, 0x6083, 0, 4, 0, 10000);
    add(drive, 0x6084, 0, 4, 0, 10000);
    add(drive, 0x6085, 0, 4, 0, 10000);
    add(drive, 0x6410, 1, 2, 0, 2000);
    add(drive, 0x6410, 2, 2, 0, 4000);
    add(drive, 0x6098, 0, 1, 0, 7);
    add(drive, 0x6099, 0, 1, READ_ONLY, 2);
    add(drive, 0x6099, 1, 4, 0, 100);
    add(drive, 0x6099, 2, 4, 0, 10);
    add(drive, 0x609A, 0, 4, 0, 1000);
    add(drive, 0x607C, 0, 4, 0, 0);
    add(drive, 0x2080, 0, 2, 0, 500);
    add(drive, 0x2081, 0, 4, 0, 0);
    add(drive, 0x2030, 0, 2, INTO_RPDO | INTO_TPDO, 0);
    add(drive, 0x2062, 0, 4, INTO_RPDO | INTO_TPDO, 0);
    add(drive, 0x206B, 0, 4, INTO_RPDO | INTO_TPDO, 0);
}

static void show(struct drive *drive)
{
    uint32_t bits = drive->nmt == OPERATIONAL ? 0x0200 : 0;
    if (drive->referenced)
        bits |= 0x8000;
    if (value_of(drive, 0x6061, 0) == HOMING && drive->referenced)
        bits |= 0x1400; /* attained, and there */
    if (value_of(drive, 0x6061, 0) == HOMING && drive->homing_error)
        bits |= 0x2000;
    find(drive, 0x6041, 0)->value = (uint32_t)drive->axis | bits;
    find(drive, 0x6064, 0)->value = (uint32_t)drive->counts - (uint32_t)drive->zero;
    find(drive, 0x606C, 0)->value = (uint32_t)drive->rpm;
    find(drive, 0x6078, 0)->value = (uint32_t)drive->milliamperes & 0xFFFF;
}

/* --- CiA 402 --- */

static bool powered(const struct drive *drive)
{
    return drive->axis == DRIVE_OPERATION_ENABLED || drive->axis == DRIVE_QUICK_STOP_ACTIVE ||
           drive->axis == DRIVE_FAULT_REACTION;
}

void drive_fail(struct drive *drive, uint16_t code)
{
    uint8_t data[8] = {(uint8_t)code, (uint8_t)(code >> 8), 1};
    find(drive, 0x1001, 0)->value |= 1;
    emit(drive, 0x80u + drive->node, data, 8);
    drive->ramp_rpm = drive->rpm;
    drive->axis = powered(drive) ? DRIVE_FAULT_REACTION : DRIVE_FAULT;
}

static void transit(struct drive *drive, uint16_t word)
{
    enum drive_axis was = drive->axis;
    bool ready = was == DRIVE_READY_TO_SWITCH_ON;
    if (!(word & 0x02)) { /* disable voltage */
        drive->axis = DRIVE_SWITCH_ON_DISABLED;
    } else if (!(word & 0x04)) { /* quick stop */
        bool on = was == DRIVE_OPERATION_ENABLED || was == DRIVE_QUICK_STOP_ACTIVE;
        if (was == DRIVE_OPERATION_ENABLED)
            drive->ramp_rpm = drive->rpm;
        drive->axis = on ? DRIVE_QUICK_STOP_ACTIVE : DRIVE_SWITCH_ON_DISABLED;
    } else if (was == DRIVE_QUICK_STOP_ACTIVE) { /* left by disable voltage only */
        return;
    } else if (!(word & 0x01)) {
        drive->axis = DRIVE_READY_TO_SWITCH_ON;
    } else if (!(word & 0x08)) {
        drive->axis = ready || was == DRIVE_OPERATION_ENABLED ? DRIVE_SWITCHED_ON : was;
    } else if (ready || was == DRIVE_SWITCHED_ON) {
        drive->axis = DRIVE_OPERATION_ENABLED;
    }
}

static void obey(struct drive *drive, uint16_t word)
{
    uint16_t rising = (uint16_t)(word & ~drive->control);
    drive->control = word;
    if (!(word & 0x10))
        drive->homing = DRIVE_NOT_HOMING;
    if (drive->axis == DRIVE_FAULT && rising & 0x80) {
        drive->axis = DRIVE_SWITCH_ON_DISABLED;
        find(drive, 0x1001, 0)->value = 0;
        emit(drive, 0x80u + drive->node, (const uint8_t[8]){0}, 8);
    } else if (drive->axis != DRIVE_FAULT && drive->axis != DRIVE_FAULT_REACTION) {
        transit(drive, word);
    }
    if (rising & 0x10 && drive->axis == DRIVE_OPERATION_ENABLED && value_of(drive, 0x6061, 0) == HOMING) {
        drive->referenced = false;
        drive->homing_error = drive->homing_fails;
        drive->ramp_rpm = drive->rpm;
        drive->homing = drive->homing_fails ? DRIVE_NOT_HOMING : DRIVE_SEARCHING;
    }
}

static void written(struct drive *drive, uint32_t index)
{
    if (index == 0x6040)
        obey(drive, (uint16_t)value_of(drive, 0x6040, 0));
    else if (index == 0x6060)
        find(drive, 0x6061, 0)->value = value_of(drive, 0x6060, 0);
}

static double limited(double value, double limit)
{
    return fmax(-limit, fmin(limit, value));
}

/* Up to an end stop, and away from it by the offset, which is the home. */
static void home(struct drive *drive, double seconds)
{
    int8_t method = (int8_t)value_of(drive, 0x6098, 0);
    int32_t rpm = (int32_t)value_of(drive, 0x6099, 1), offset = (int32_t)value_of(drive, 0x607C, 0);
    bool stopped = (uint32_t)abs(drive->milliamperes) >= value_of(drive, 0x2080, 0);
    drive->mode = -2;
    drive->demand = 0;
    if (drive->homing == DRIVE_SEARCHING && (method == 35 || stopped)) {
        drive->homing = DRIVE_LEAVING;
        drive->found = drive->counts;
    } else if (drive->homing == DRIVE_SEARCHING) {
        double change = value_of(drive, 0x609A, 0) * seconds;
        drive->ramp_rpm += limited((method == -4 ? -rpm : rpm) - drive->ramp_rpm, change);
        drive->demand = drive->ramp_rpm;
    }
    if (drive->homing == DRIVE_LEAVING && abs(drive->counts - drive->found - offset) <= 20) {
        drive->zero = drive->found + offset - (int32_t)value_of(drive, 0x2081, 0);
        drive->referenced = true;
        drive->homing = DRIVE_NOT_HOMING;
    } else if (drive->homing == DRIVE_LEAVING) {
        drive->mode = -1;
        drive->demand = drive->found + offset;
    }
}

/* What the inner loops are told. */
static void command(struct drive *drive, double seconds)
{
    drive->mode = powered(drive) ? (int8_t)value_of(drive, 0x6061, 0) : 0;
    if (drive->axis == DRIVE_QUICK_STOP_ACTIVE || drive->axis == DRIVE_FAULT_REACTION) {
        double change = value_of(drive, 0x6085, 0) * seconds;
        drive->ramp_rpm -= limited(drive->ramp_rpm, change);
        drive->mode = -2;
        drive->demand = drive->ramp_rpm;
        if (drive->axis == DRIVE_FAULT_REACTION && fabs(drive->ramp_rpm) < 1)
            drive->axis = DRIVE_FAULT;
    } else if (drive->mode == HOMING) {
        home(drive, seconds);
    } else if (drive->mode == -1) {
        drive->demand = (double)(int32_t)value_of(drive, 0x2062, 0) + drive->zero;
    } else if (drive->mode == -2) {
        drive->demand = limited((int32_t)value_of(drive, 0x206B, 0), value_of(drive, 0x607F, 0));
    } else if (drive->mode == -3) {
        drive->demand = limited((int16_t)value_of(drive, 0x2030, 0), value_of(drive, 0x6410, 2));
    }
}

/* --- SDO --- */

/* 0, or why this mapping cannot be. */
static uint32_t check_mapping(struct drive *drive, uint32_t index, uint32_t sub, uint32_t value)
{
    uint32_t bits = 0;
    if (!(value_of(drive, index - 0x200, 1) & PDO_OFF))
        return WRONG_STATE;
    for (uint32_t i = 1; sub == 0 && i <= value && i <= 8; i++)
        bits += value_of(drive, index, i) & 0xFF;
    if (sub == 0)
        return value > 8 || bits > 64 ? PDO_TOO_LONG : 0;
    if (value_of(drive, index, 0))
        return WRONG_STATE;
    const struct drive_entry *mapped = find(drive, value >> 16, value >> 8 & 0xFF);
    uint8_t direction = index < 0x1A00 ? INTO_RPDO : INTO_TPDO;
    bool good = mapped && mapped->flags & direction && (value & 0xFF) == 8u * mapped->size;
    return !value || good ? 0 : NOT_MAPPABLE;
}

static uint32_t write_object(struct drive *drive, struct drive_entry *entry, uint32_t value, size_t size)
{
    if (entry->flags & READ_ONLY)
        return IS_READ_ONLY;
    if (size != entry->size)
        return WRONG_LENGTH;
    if (entry->index == 0x607F && value > 25000)
        return OUT_OF_RANGE;
    if (entry->index == 0x6060 && value != 0xFF && value != 0xFE && value != 0xFD && value != HOMING)
        return OUT_OF_RANGE;
    if (entry->index == 0x6098 && value != 0xFC && value != 0xFD && value != 35)
        return OUT_OF_RANGE;
    if ((entry->index & 0xFFFC) == 0x1600 || (entry->index & 0xFFFC) == 0x1A00) {
        uint32_t abort = check_mapping(drive, entry->index, entry->sub, value);
        if (abort)
            return abort;
    }
    entry->value = value;
    written(drive, entry->index);
    return 0;
}

static uint32_t serve(struct drive *drive, const uint8_t *request, uint8_t answer[8])
{
    uint32_t index = get(request + 1, 2), sub = request[3];
    struct drive_entry *entry = find(drive, index, sub);
    if (!entry) {
        bool there = false;
        for (size_t i = 0; i < drive->entries; i++)
            there |= drive->entry[i].index == index;
        return there ? NO_SUB_INDEX : NO_OBJECT;
    }
    if (request[0] >> 5 == 1 && request[0] & 0x02) {
        size_t size = request[0] & 1 ? 4u - (request[0] >> 2 & 3u) : entry->size;
        answer[0] = 0x60;
        return write_object(drive, entry, get(request + 4, size), size);
    }
    if (request[0] >> 5 != 2)
        return BAD_COMMAND;
    show(drive);
    answer[0] = (uint8_t)(0x43 | (4 - entry->size) << 2);
    put(answer + 4, entry->size, entry->value);
    return 0;
}

static void answer_sdo(struct drive *drive, const uint8_t *request)
{
    uint8_t answer[8] = {0};
    memcpy(answer + 1, request + 1, 3);
    uint32_t abort = serve(drive, request, answer);
    if (abort) {
        answer[0] = 0x80;
        put(answer + 4, 4, abort);
    }
    emit(drive, 0x580u + drive->node, answer, 8);
}

/* --- PDOs --- */

static void take_pdo(struct drive *drive, const struct can_frame *frame)
{
    for (uint32_t n = 0; n < 4; n++) {
        uint32_t id = value_of(drive, 0x1400 + n, 1), count = value_of(drive, 0x1600 + n, 0), at = 0, word = 0;
        if (id & PDO_OFF || (id & 0x7FF) != frame->can_id)
            continue;
        for (uint32_t sub = 1; sub <= count; sub++) {
            uint32_t name = value_of(drive, 0x1600 + n, sub);
            struct drive_entry *entry = find(drive, name >> 16, name >> 8 & 0xFF);
            if (at + entry->size > frame->len) {
                drive_fail(drive, 0x8210); /* PDO too short */
                return;
            }
            entry->value = get(frame->data + at, entry->size);
            at += entry->size;
            if (entry->index == 0x6040)
                word = 0x6040; /* after the set points, which it starts */
            else
                written(drive, entry->index);
        }
        if (word)
            written(drive, word);
    }
}

static void synchronise(struct drive *drive)
{
    show(drive);
    for (uint32_t n = 0; n < 4 && drive->nmt == OPERATIONAL; n++) {
        uint32_t id = value_of(drive, 0x1800 + n, 1), count = value_of(drive, 0x1A00 + n, 0);
        uint8_t data[8] = {0}, length = 0;
        if (id & PDO_OFF || value_of(drive, 0x1800 + n, 2) != 1)
            continue;
        for (uint32_t sub = 1; sub <= count; sub++) {
            uint32_t name = value_of(drive, 0x1A00 + n, sub);
            const struct drive_entry *entry = find(drive, name >> 16, name >> 8 & 0xFF);
            put(data + length, entry->size, entry->value);
            length = (uint8_t)(length + entry->size);
        }
        emit(drive, id & 0x7FF, data, length);
    }
}

/* --- NMT, heartbeats --- */

static void reset(struct drive *drive, bool whole)
{
    uint32_t mode = 0xFE;
    if (!whole)
        mode = value_of(drive, 0x6060, 0);
    add_objects(drive);
    find(drive, 0x6060, 0)->value = find(drive, 0x6061, 0)->value = mode;
    if (whole) {
        drive->axis = DRIVE_SWITCH_ON_DISABLED;
        drive->zero = drive->counts; /* the encoder counts from 0 */
        drive->referenced = false;
    }
    drive->homing = DRIVE_NOT_HOMING;
    drive->nmt = PRE_OPERATIONAL;
    drive->heard_ns = 0;
    drive->beat_ns = drive->now_ns;
    emit(drive, 0x700u + drive->node, (const uint8_t[1]){BOOTING}, 1);
}

static void lead(struct drive *drive, uint8_t what)
{
    bool leaves = what == 0x02 || what == 0x80 || what == 0x81 || what == 0x82;
    if (leaves && drive->nmt == OPERATIONAL && powered(drive))
        drive->axis = DRIVE_SWITCH_ON_DISABLED; /* abort connection */
    if (what == 0x01)
        drive->nmt = OPERATIONAL;
    else if (what == 0x02)
        drive->nmt = STOPPED;
    else if (what == 0x80)
        drive->nmt = PRE_OPERATIONAL;
    else if (what == 0x81 || what == 0x82)
        reset(drive, what == 0x81);
}

void drive_begin(struct drive *drive, uint8_t node, int64_t now_ns, int32_t counts)
{
    *drive = (struct drive){.node = node, .now_ns = now_ns, .counts = counts};
    reset(drive, true);
}

void drive_take(struct drive *drive, const struct can_frame *frame)
{
    uint32_t id = frame->can_id, node = drive->node;
    if (id & (CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_ERR_FLAG))
        return;
    if (id == 0) {
        if (frame->len == 2 && (frame->data[1] == 0 || frame->data[1] == node))
            lead(drive, frame->data[0]);
    } else if (id == (value_of(drive, 0x1005, 0) & 0x7FF)) {
        synchronise(drive);
    } else if (id == 0x600 + node) {
        if (frame->len == 8 && drive->nmt != STOPPED && frame->data[0] != 0x80)
            answer_sdo(drive, frame->data);
    } else if ((id & 0x780) == 0x700) {
        if ((value_of(drive, 0x1016, 1) >> 16 & 0x7F) == (id & 0x7F))
            drive->heard_ns = drive->now_ns;
    } else if (drive->nmt == OPERATIONAL) {
        take_pdo(drive, frame);
    }
}

void drive_advance(struct drive *drive, int64_t now_ns)
{
    double seconds = 1e-9 * (double)(now_ns - drive->now_ns);
    drive->now_ns = now_ns;
    int64_t allowed_ns = (value_of(drive, 0x1016, 1) & 0xFFFF) * MILLISECOND;
    if (allowed_ns && drive->heard_ns && now_ns - drive->heard_ns > allowed_ns) {
        drive->heard_ns = 0; /* watched again from the next heartbeat on */
        if (value_of(drive, 0x6007, 0) == 1)
            drive_fail(drive, 0x8130);
    }
    int64_t beat_ns = value_of(drive, 0x1017, 0) * MILLISECOND;
    if (beat_ns && now_ns - drive->beat_ns >= beat_ns) {
        drive->beat_ns = now_ns;
        emit(drive, 0x700u + drive->node, &drive->nmt, 1);
    }
    command(drive, seconds);
}
