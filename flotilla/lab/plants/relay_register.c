/* The other end of a relay board: what was written to its first register, read back from the I/O port. */
#define _DEFAULT_SOURCE
#include <errno.h>
#include <flotilla/block.h>
#include <string.h>
#include <sys/io.h>

enum { RELAYS = 8 };

struct relay_register {
    int64_t base;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct relay_register, base, .default_value = "0x300", .min = 0, .max = 0xFFFF,
                 .summary = "I/O port of relays 1 to 8"),
};

static const struct fl_port outputs[] = {
    {.name = "relays", .type = FL_BOOLEAN, .width = RELAYS, .summary = "1: energised, its valve is open"},
};

static unsigned short port(const struct fl_block *block)
{
    const struct relay_register *relays = block->parameters;
    return (unsigned short)relays->base;
}

static int start(struct fl_block *block)
{
    if (ioperm(port(block), 1, 1) < 0)
        return fl_fail(block, "I/O port 0x%x: %s; it needs the privilege CAP_SYS_RAWIO", port(block), strerror(errno));
    return FL_OK;
}

static int step(struct fl_block *block)
{
    unsigned bits = inb(port(block));
    bool *relays = block->out[0];
    for (unsigned i = 0; i < RELAYS; i++)
        relays[i] = bits >> i & 1;
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    ioperm(port(block), 1, 0);
}

FL_BLOCK(relay_register) = {
    .abi = FL_ABI,
    .name = "relay-register",
    .summary = "relays 1 to 8 as an I/O port reads back",
    .source = "Diamond Systems, IR-104-PBF User Manual: register map",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct relay_register),
    .start = start,
    .step = step,
    .terminate = terminate,
};
