/* A Maxon EPOS2 drive as seen by a CANopen master: takes and returns frames, and is given the time. It does no I/O, so
 * it can be tested and fuzzed with any frames.
 *
 * It brings the drive from any state into operation and keeps it there: reset of communication, configuration by SDO
 * with every answer checked, NMT start, then the state machine of CiA 402, one acknowledged transition after the other.
 * It relies on no identifier and no mapping that the drive has stored: it writes all of its PDOs. Values are sampled by
 * SYNC. Both sides send heartbeats. A drive that falls silent is taken for lost and set up again, and a drive that
 * misses our heartbeats stops its motor by itself. Only epos2_advance sends ours, so whatever stops the control task
 * stops the motor.
 *
 * The motor is switched on when `enable` goes from 0 to 1. After a fault, after the drive was lost, or after it left
 * operation by itself, this takes another such edge while the drive is there. Only before the first contact does an
 * edge wait for the drive.
 *
 * With a homing method, a drive that does not say that its position is referenced searches its home in the mode of that
 * name, each time before it follows the target, and only while `enable` is on. A search that fails, or takes too long,
 * switches the motor off until `enable` goes from 0 to 1.
 *
 * Sources: CiA 301 4.2, CiA 402-2; Maxon, EPOS2 Firmware Specification, and the EDS of the drive for its defaults.
 */
#ifndef FLOTILLA_EPOS2_H
#define FLOTILLA_EPOS2_H

#include <linux/can.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* In the order of the parameter `mode`. */
enum epos2_mode { EPOS2_POSITION, EPOS2_VELOCITY, EPOS2_CURRENT, EPOS2_PROFILE_POSITION, EPOS2_PROFILE_VELOCITY };

struct epos2_settings {
    uint8_t node, master;    /* addresses on the bus */
    enum epos2_mode mode;    /*                      */
    uint16_t heartbeat_ms;   /* longest silence that either side tolerates */
    double counts_per_rad;   /* of the encoder, at the gear's output */
    double rpm_per_rad_s;    /* of the motor, for the gear's output */
    uint32_t max_rpm;        /* profile velocity; 0 here and below: what the drive has stored */
    uint32_t rpm_per_s;      /* acceleration and deceleration of profiles, and of homing */
    uint32_t stop_rpm_per_s; /* deceleration of a quick stop */
    uint16_t limit_ma;       /* output current */
    int8_t homing_method;    /* object 6098; 0: none */
    uint32_t homing_rpm;     /* of the search; 0 here and below: what the drive has stored */
    uint16_t homing_ma;      /* by which an end stop is felt */
    int32_t homing_offset;   /* counts from where the search ends to the position 0 */
    int64_t homing_ns;       /* longest search */
    bool automatic_reset;    /* of faults, once a second; otherwise only by switching `enable` on again */
    bool automatic_restart;  /* restart of the motor, as soon as the drive can; otherwise only by `enable`, too */
};

struct epos2_command {
    bool enable;
    bool sync;     /* end with a SYNC: for all drives on the bus, so one of them in each period */
    double target; /* rad, rad/s or A, by mode; a value that is not finite is no command, and stops the motor */
};

struct epos2_values {
    double position, velocity, current; /* rad, rad/s, A */
};

enum epos2_phase {
    EPOS2_BOOTING,     /* a reset of its communication was sent; waiting for its boot-up message */
    EPOS2_CONFIGURING, /* by SDO, one at a time */
    EPOS2_RUNNING,
    EPOS2_REFUSED, /* it aborted the configuration; tried again after a second */
};

/* Why the drive does not work: the first cause, until it works again. */
enum epos2_cause {
    EPOS2_FINE,
    EPOS2_NO_ANSWER,    /* to a reset of its communication, or to an SDO */
    EPOS2_NO_HEARTBEAT, /* it worked, and fell silent */
    EPOS2_ABORTED,      /* it refused an object: `code` is the abort code */
    EPOS2_EMERGENCY,    /* `code` is the error code of its EMCY message */
    EPOS2_NOT_HOMED,    /* the search for its home: `code` is 0, it says that it failed, or 1, it takes too long */
};

struct epos2_trouble {
    enum epos2_cause cause;
    uint16_t index; /* of the object refused */
    uint8_t sub;
    uint32_t code;
};

enum {
    EPOS2_WRITES = 64, /* SDOs of a configuration, at most */
    EPOS2_FRAMES = 4,  /* frames of one call, at most */
    /* Heartbeats of either side in the longest silence that the other tolerates: two in a row may be lost, and the
     * third late. */
    EPOS2_HEARTBEATS = 4,
};

struct epos2_write {
    uint16_t index;
    uint8_t sub, size;
    uint32_t value;
};

struct epos2 {
    struct epos2_settings settings;
    struct epos2_write writes[EPOS2_WRITES];
    size_t write_count, write_next;
    enum epos2_phase phase;
    bool sdo_waiting, reset_sent;
    int64_t phase_ns, sdo_ns;          /* begin of the phase, of the SDO that waits */
    int64_t received_ns, heartbeat_ns; /* its last heartbeat, ours */
    int64_t advanced_ns;               /* the last epos2_advance */
    int64_t stop_ns, reset_ns;         /* begin of a quick stop, the last fault reset */
    bool stopping, reset_wanted, was_enabled;
    bool contacted; /* it has been in operation */
    bool armed;     /* `enable` has gone from 0 to 1 since the drive last failed */
    uint16_t control_word;
    uint16_t status_before; /* at the last control word */
    bool have_position;
    int64_t position_ns;
    int32_t counts;
    enum { SETPOINT_NONE, SETPOINT_OFFERED, SETPOINT_TAKEN } setpoint_state; /* of profile position */
    int32_t setpoint;
    enum { SEARCH_NONE, SEARCH_BEGUN, SEARCH_FAILED } search_state;
    int64_t search_ns; /* its begin */

    /* What is known of the drive. */
    uint16_t status_word;
    bool status_known;
    int8_t mode_display;
    uint16_t error_code; /* of its last EMCY message; 0: none since the fault was reset */
    uint32_t abort_code; /* of the SDO that was refused last; 0: none */
    struct epos2_write abort_write;
    struct epos2_trouble trouble;
    struct epos2_values values;
    int64_t values_ns; /* when the older of them arrived */
    uint32_t sequence; /* complete sets of values */
};

/* The identifiers that the drive sends, for the filter of the kernel; returns their number. */
enum { EPOS2_IDENTIFIERS = 6 };
void epos2_identifiers(const struct epos2_settings *settings, uint32_t identifiers[EPOS2_IDENTIFIERS]);

void epos2_begin(struct epos2 *drive, const struct epos2_settings *settings);

/* The connection to the bus was interrupted: set the drive up again in the next epos2_advance. */
void epos2_lose(struct epos2 *drive);

/* Take a frame that arrived at `at_ns`. Frames of others and malformed ones change nothing. */
void epos2_receive(struct epos2 *drive, const struct can_frame *frame, int64_t at_ns);

/* Write the frames to send now, in order; returns their number. Call it once per period. */
size_t epos2_advance(struct epos2 *drive, int64_t now_ns, const struct epos2_command *command,
                     struct can_frame out[EPOS2_FRAMES]);

/* Write the frames of a quick stop, in every phase: by the PDO of commands, by RPDO1, which carries the control word
 * alone, and by SDO, which no setting of the drive changes. So this also stops a drive that an earlier program left
 * running. In every state but operation it takes the power off. */
size_t epos2_quick_stop(const struct epos2 *drive, struct can_frame out[EPOS2_FRAMES]);

/* The motor has power, as far as is known of a drive that works: epos2_advance without `enable` stops it, and then
 * takes its power off. */
bool epos2_powered(const struct epos2 *drive);

/* Write the last frames: power off, in every phase, and no monitoring of our heartbeats any more. */
size_t epos2_shutdown(const struct epos2 *drive, struct can_frame out[EPOS2_FRAMES]);

/* The position is that from the home, or no homing is asked for. */
bool epos2_homed(const struct epos2 *drive);

/* The drive follows the target: it is enabled and says that it is in the mode asked for. */
bool epos2_enabled(const struct epos2 *drive);

#endif
