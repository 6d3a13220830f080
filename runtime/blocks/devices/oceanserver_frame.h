/* What an OceanServer battery controller sends once it is told to stream in hexadecimal: records of number and value.
 * FFFF, or FF of two digits, may stand for a collision on the controller's SMBus, as its maker told the authors of
 * gearbox (gbxsmartbatteryacfr/smartbatteryparsing.cpp). So a current of -1 mA is no measurement. */
#ifndef FLOTILLA_OCEANSERVER_FRAME_H
#define FLOTILLA_OCEANSERVER_FRAME_H

#include "record.h"

enum { OCEANSERVER_BATTERIES = 8, OCEANSERVER_VALUES = 16 };

enum oceanserver_kind { OCEANSERVER_SYSTEM, OCEANSERVER_CONTROLLER, OCEANSERVER_BATTERY };

/* Numbers of values: $S and $C are the controller's own, $B the registers of the Smart Battery Data Specification 1.1.
 */
enum {
    OCEANSERVER_S_MINUTES = 0x01,
    OCEANSERVER_S_TEXT = 0x03, /* a message, of any characters */
    OCEANSERVER_S_CHARGE = 0x04,
    OCEANSERVER_C_PRESENT = 0x01,
    OCEANSERVER_C_CHARGING = 0x02,
    OCEANSERVER_C_DISCHARGING = 0x03,
    OCEANSERVER_C_EXTERNAL_POWER = 0x05,
    OCEANSERVER_C_POWER_NOT_GOOD = 0x06,
    OCEANSERVER_C_INHIBITED = 0x07,
    OCEANSERVER_B_TEMPERATURE = 0x08, /* 0.1 K */
    OCEANSERVER_B_VOLTAGE = 0x09,     /* mV */
    OCEANSERVER_B_CURRENT = 0x0A,     /* mA, signed, charging is positive */
    OCEANSERVER_B_CHARGE = 0x0D,      /* % */
};

struct oceanserver_sample {
    uint8_t kind;       /* enum oceanserver_kind */
    uint8_t controller; /* 1 to 9, of OCEANSERVER_CONTROLLER and OCEANSERVER_BATTERY */
    uint8_t battery;    /* 1 to 9, of OCEANSERVER_BATTERY */
    uint8_t count;
    struct {
        uint8_t number;
        uint16_t value;
    } values[OCEANSERVER_VALUES];
};

/* The value of that number; false where the record has none, or a collision instead. */
bool oceanserver_value(const struct oceanserver_sample *sample, uint8_t number, uint16_t *value);

bool oceanserver_feed(struct record *record, uint8_t byte, struct oceanserver_sample *sample);

#endif
