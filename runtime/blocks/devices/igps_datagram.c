#include "igps_datagram.h"

#include <math.h>
#include <string.h>

static double read_double(const uint8_t *bytes, enum igps_byte_order order)
{
    uint64_t bits = 0;
    double value;
    for (int i = 0; i < 8; i++)
        bits = bits << 8 | bytes[order == IGPS_BIG_ENDIAN ? i : 7 - i];
    memcpy(&value, &bits, sizeof value);
    return value;
}

bool igps_read(const uint8_t *bytes, size_t count, enum igps_byte_order order, double range,
               struct igps_position *position)
{
    if (count != IGPS_BYTES)
        return false;
    const struct igps_position read = {.y = read_double(bytes, order), .x = read_double(bytes + 8, order)};
    /* Comparisons with NaN are false. */
    if (!(fabs(read.x) <= range && fabs(read.y) <= range))
        return false;
    *position = read;
    return true;
}
