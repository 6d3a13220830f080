/* What serves one block alone, on the whole computer: devices that parameters name (fl_device, FL_EXCLUSIVE).
 *
 * Within a task, two blocks on one device are refused when it is read. Between processes, what moves something (a type
 * with `safe`) is claimed before it starts, by an abstract Unix socket of the device's name: the kernel gives it up
 * with the process, however that ends, and says whose it is. It needs no directory and no privilege, and belongs to the
 * network namespace. Sensors on serial ports have a lock of their own, which they wait for.
 */
#ifndef FLOTILLA_DEVICE_H
#define FLOTILLA_DEVICE_H

#include "service.h"

#include <stdio.h>

/* The parameter `device`, or all of FL_EXCLUSIVE together, as a user writes them; false: the block has none. */
bool device_write(const struct fl_block *block, FILE *out);

/* Claim what the block has until the process ends or block_destroy(), waiting for another process to end as long as the
 * service's `patience_ms` says. FL_FAILED with the holder as the reason. */
int device_claim(struct fl_block *block);
void device_release(struct fl_service *service);

#endif
