/* The datagram of the indoor positioning system, separate from sockets, so that a test can feed it anything. */
#ifndef FLOTILLA_DEVICES_IGPS_DATAGRAM_H
#define FLOTILLA_DEVICES_IGPS_DATAGRAM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { IGPS_BYTES = 16 }; /* two doubles (IEEE 754), Y before X */

enum igps_byte_order { IGPS_LITTLE_ENDIAN, IGPS_BIG_ENDIAN };

struct igps_position {
    double x, y; /* m */
};

/* True when `bytes` are a position within `range` of the origin along both axes; `position` is left alone otherwise. */
bool igps_read(const uint8_t *bytes, size_t count, enum igps_byte_order order, double range,
               struct igps_position *position);

#endif
