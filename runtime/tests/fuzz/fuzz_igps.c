/* libFuzzer's entry for the datagram of the indoor positioning system: no stream, so no subject of subject.h. What is
 * believed is checked against the bytes by other code than the parser's. */
#include "blocks/devices/igps_datagram.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t count);

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t count)
{
    for (int order = IGPS_LITTLE_ENDIAN; order <= IGPS_BIG_ENDIAN; order++) {
        struct igps_position position = {0};
        double numbers[2];
        if (!igps_read(bytes, count, (enum igps_byte_order)order, 100, &position))
            continue;
        if (count != sizeof numbers || !isfinite(position.x) || !isfinite(position.y) || fabs(position.x) > 100 ||
            fabs(position.y) > 100)
            abort();
        memcpy(numbers, bytes, sizeof numbers); /* on a processor of that order */
        if (order == IGPS_LITTLE_ENDIAN && (numbers[0] != position.y || numbers[1] != position.x))
            abort();
    }
    return 0;
}
