#include "epos2_text.h"

#include <stddef.h>

struct meaning {
    uint32_t code;
    const char *text;
};

static const struct meaning aborts[] = {
    {0x05030000, "toggle bit not alternated"},
    {0x05040000, "SDO protocol timed out"},
    {0x05040001, "command specifier not valid or unknown"},
    {0x05040002, "invalid block size"},
    {0x05040003, "invalid sequence number"},
    {0x05040004, "CRC error"},
    {0x05040005, "out of memory"},
    {0x06010000, "unsupported access to an object"},
    {0x06010001, "attempt to read a write-only object"},
    {0x06010002, "attempt to write a read-only object"},
    {0x06020000, "object does not exist in the object dictionary"},
    {0x06040041, "object cannot be mapped to the PDO"},
    {0x06040042, "number and length of the mapped objects exceed the PDO's length"},
    {0x06040043, "general parameter incompatibility"},
    {0x06040047, "general internal incompatibility in the device"},
    {0x06060000, "access failed due to a hardware error"},
    {0x06070010, "data type or length of the parameter does not match"},
    {0x06070012, "data type does not match, parameter too long"},
    {0x06070013, "data type does not match, parameter too short"},
    {0x06090011, "sub-index does not exist"},
    {0x06090030, "value range of the parameter exceeded"},
    {0x06090031, "value of the parameter too high"},
    {0x06090032, "value of the parameter too low"},
    {0x06090036, "maximum value is less than minimum value"},
    {0x060A0023, "resource not available"},
    {0x08000000, "general error"},
    {0x08000020, "data cannot be transferred or stored"},
    {0x08000021, "data cannot be transferred or stored because of local control"},
    {0x08000022, "data cannot be transferred or stored in the present device state"},
    {0x08000023, "no object dictionary is present"},
    {0x08000024, "no data available"},
};

static const struct meaning errors[] = {
    {0x1000, "generic error"},
    {0x2310, "over-current"},
    {0x3210, "over-voltage"},
    {0x3220, "under-voltage"},
    {0x4210, "over-temperature"},
    {0x5113, "logic supply voltage too low"},
    {0x5114, "supply voltage of the output stage too low"},
    {0x6100, "internal software error"},
    {0x6320, "software parameter error"},
    {0x7320, "position sensor error"},
    {0x8110, "CAN overrun, objects lost"},
    {0x8111, "CAN overrun"},
    {0x8120, "CAN passive mode"},
    {0x8130, "heartbeat of the master lost"},
    {0x8150, "CAN transmit COB-ID collision"},
    {0x81FD, "CAN bus off"},
    {0x81FE, "CAN receive queue overrun"},
    {0x81FF, "CAN transmit queue overrun"},
    {0x8210, "PDO length error"},
    {0x8611, "following error"},
    {0xFF01, "Hall sensor error"},
    {0xFF02, "index processing error"},
    {0xFF03, "encoder resolution error"},
    {0xFF04, "no Hall sensor found"},
    {0xFF06, "negative limit switch"},
    {0xFF07, "positive limit switch"},
    {0xFF08, "Hall angle detection error"},
    {0xFF09, "software position limit"},
    {0xFF0A, "position sensor breach"},
    {0xFF0B, "system overloaded"},
};

static const char *text_of(const struct meaning *meanings, size_t count, uint32_t code)
{
    for (size_t i = 0; i < count; i++)
        if (meanings[i].code == code)
            return meanings[i].text;
    return "unknown";
}

const char *epos2_abort_text(uint32_t code)
{
    return text_of(aborts, sizeof aborts / sizeof aborts[0], code);
}

const char *epos2_error_text(uint16_t code)
{
    return text_of(errors, sizeof errors / sizeof errors[0], code);
}
