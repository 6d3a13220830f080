/* Ports that `configure` adds. */
#ifndef FLOTILLA_SIGNAL_PORTS_H
#define FLOTILLA_SIGNAL_PORTS_H

#include <flotilla/block.h>

/* Of a parameter that is an enum fl_type. */
#define TYPE_CHOICES "boolean|int8|uint8|int16|uint16|int32|uint32|int64|uint64|single|double"

/* "in0", "in1", ...: stem and number, in the block's memory. NULL after fl_fail(). */
const char *port_numbered(struct fl_block *block, const char *stem, uint32_t number);

#endif
