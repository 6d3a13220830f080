/* Ports that `configure` adds. */
#ifndef FLOTILLA_SIGNAL_PORTS_H
#define FLOTILLA_SIGNAL_PORTS_H

#include <flotilla/block.h>

/* "in0", "in1", ...: stem and number, in the block's memory. NULL after fl_fail(). */
const char *port_numbered(struct fl_block *block, const char *stem, uint32_t number);

#endif
