/* Exclusive use of devices that parameters name (struct fl_device, FL_EXCLUSIVE).
 *
 * Within a task, two blocks on one device are refused when the task file is read. Between processes, an actuator (a
 * type with `safe`) claims its device before it starts (core/claim.h). Processes that do not count, such as apps
 * beside a control task, hold up nobody. Sensors on serial ports use a lock of their own, for which they
 * wait.
 */
#ifndef FLOTILLA_DEVICE_H
#define FLOTILLA_DEVICE_H

#include "core/service.h"

#include <stdio.h>

/* Write the parameter `device`, or all parameters with FL_EXCLUSIVE, as a user writes them. False: the block has none.
 */
bool device_write(const struct fl_block *block, FILE *out);

/* Claim the block's device until the process ends or block_destroy(). Waits up to the service's `patience_ms` for
 * another process to end. FL_FAILED, with the holder in the reason. */
int device_claim(struct fl_block *block);
void device_release(struct fl_service *service);

#endif
