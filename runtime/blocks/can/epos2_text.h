/* What the codes of a drive mean, for the journal. */
#ifndef FLOTILLA_EPOS2_TEXT_H
#define FLOTILLA_EPOS2_TEXT_H

#include <stdint.h>

/* Of an SDO abort code (CiA 301 4.2, table 22), of an EMCY error code (CiA 301, table 26; Maxon, EPOS2 Firmware
 * Specification, error codes). "unknown" where neither has it. */
const char *epos2_abort_text(uint32_t code);
const char *epos2_error_text(uint16_t code);

#endif
