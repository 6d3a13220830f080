/* The engine of the EPOS2 drive against any frames: each ten bytes are one, its sender, its length and its data, and a
 * period passes after it. Whatever arrives, the motor is switched on only from the state that allows it. */
#include "blocks/can/epos2.h"

#include <stdlib.h>
#include <string.h>

enum { NODE = 5, RECORD = 10, PERIOD_NS = 10 * 1000 * 1000 };

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void check(const struct epos2 *drive, const struct can_frame *frame)
{
    bool operates = frame->can_id == 0x500 + NODE && (frame->data[0] & 0x0F) == 0x0F;
    uint16_t axis = drive->status_word & 0x6F;
    if (frame->len > CAN_MAX_DLEN || (operates && axis != 0x23 && axis != 0x27))
        abort();
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static const uint16_t senders[] = {0x080, 0x180, 0x280, 0x380, 0x480, 0x580, 0x700, 0x000};
    const struct epos2_settings settings = {.node = NODE,
                                            .master = 127,
                                            .mode = size ? (enum epos2_mode)(data[0] % 5) : EPOS2_POSITION,
                                            .heartbeat_ms = 100,
                                            .counts_per_rad = 318.3,
                                            .rpm_per_rad_s = 9.55,
                                            .automatic_reset = true,
                                            .automatic_restart = true};
    struct epos2 drive;
    int64_t now_ns = 0;
    epos2_begin(&drive, &settings);
    for (; size >= RECORD; data += RECORD, size -= RECORD, now_ns += PERIOD_NS) {
        const struct epos2_command command = {.enable = data[1] < 0xF0, .sync = true, .target = (int8_t)data[2] * 1e3};
        struct can_frame frame = {.can_id = senders[data[0] % 8] + NODE}, out[EPOS2_FRAMES];
        frame.len = data[1] % 9;
        memcpy(frame.data, data + 2, 8);
        epos2_receive(&drive, &frame, now_ns);
        size_t count = epos2_advance(&drive, now_ns, &command, out);
        if (count > EPOS2_FRAMES)
            abort();
        for (size_t i = 0; i < count; i++)
            check(&drive, &out[i]);
    }
    return 0;
}
