/* A Maxon EPOS2 drive as a CANopen slave, for plants in virtual time, where flotilla/lab/emulators/epos2.py is too
 * slow: the same facts and the same behaviour, as far as control tasks use it. It takes and returns frames, and is
 * given the time.
 *
 * It knows SDO (expedited), NMT, heartbeats both ways, EMCY, PDOs that are sent at each SYNC and taken at once, and the
 * state machine of CiA 402 in the modes position (-1), velocity (-2), current (-3) and homing (6) by an end stop that
 * it feels by its current (methods -3 and -4), or where it is (35). It does not know PDOs by event, profiles, and
 * storing. Its motor is elsewhere: `measured` comes in, `demand` goes out.
 *
 * Sources: CiA 301 4.2; CiA 402-2; Maxon, EPOS2 Firmware Specification.
 */
#ifndef EPOS2_DRIVE_H
#define EPOS2_DRIVE_H

#include <linux/can.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { DRIVE_ENTRIES = 176, DRIVE_OUT = 16 };

struct drive_entry {
    uint16_t index;
    uint8_t sub, size;
    uint8_t flags;
    uint32_t value;
};

enum drive_axis {
    DRIVE_SWITCH_ON_DISABLED = 0x0140, /* the status words by which an EPOS2 tells them */
    DRIVE_READY_TO_SWITCH_ON = 0x0121,
    DRIVE_SWITCHED_ON = 0x0123,
    DRIVE_OPERATION_ENABLED = 0x0137,
    DRIVE_QUICK_STOP_ACTIVE = 0x0117,
    DRIVE_FAULT_REACTION = 0x011F,
    DRIVE_FAULT = 0x0108,
};

struct drive {
    uint8_t node;
    struct drive_entry entry[DRIVE_ENTRIES];
    size_t entries;
    enum drive_axis axis;
    uint8_t nmt; /* as in a heartbeat */
    uint16_t control;
    int64_t now_ns, heard_ns, beat_ns; /* heard: 0, nobody is waited for */
    double ramp_rpm;                   /* of a quick stop */
    struct can_frame out[DRIVE_OUT];
    size_t out_count;
    enum { DRIVE_NOT_HOMING, DRIVE_SEARCHING, DRIVE_LEAVING } homing;
    bool referenced, homing_error;
    int32_t zero, found; /* counts of the motor at the position 0, and where the search ended */
    uint32_t dropped;    /* frames for which `out` had no room */

    /* The motor, counts and rpm of its shaft, mA. */
    int32_t counts, rpm, milliamperes;
    bool homing_fails; /* set from outside: each search does */
    /* What it is told: -1, -2 or -3 as in object 6061, or 0 for no power; counts of the motor, rpm or mA. */
    int8_t mode;
    double demand;
};

/* Power on, the motor at `counts`, which becomes the position 0: it says so. */
void drive_begin(struct drive *drive, uint8_t node, int64_t now_ns, int32_t counts);

/* Take a frame from the bus. What it sends is in `out`; the caller empties it by out_count = 0. */
void drive_take(struct drive *drive, const struct can_frame *frame);

/* Let time pass up to `now_ns`, the motor as it is then. */
void drive_advance(struct drive *drive, int64_t now_ns);

/* It finds an error: it tells, stops the motor and stays in fault. */
void drive_fail(struct drive *drive, uint16_t code);

#endif
