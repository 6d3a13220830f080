/* An actuator that is switched as a file says, for the tests of starts: its trace has what it does. */
#include <fcntl.h>
#include <flotilla/block.h>
#include <string.h>
#include <unistd.h>

struct held {
    struct fl_device device;
    const char *command; /* a file: "1" commands it on, "0" off; without one there is no command */
    double timeout;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct held, device),
    FL_PARAMETER(struct held, command),
    FL_PARAMETER(struct held, timeout, .flags = FL_ACTUATOR_TIMEOUT, .default_value = "1"),
};

static const struct fl_port outputs[] = {{.name = "out", .type = FL_BOOLEAN, .width = 1}};

static char command_of(const struct fl_block *block)
{
    const struct held *held = block->parameters;
    char byte = ' ';
    int fd = open(held->command, O_RDONLY);
    if (fd >= 0 && read(fd, &byte, 1) != 1)
        byte = ' ';
    if (fd >= 0)
        close(fd);
    return byte;
}

static int step(struct fl_block *block)
{
    char command = command_of(block);
    bool acts = fl_may_act(block, command == '0') && command == '1';
    FL_OUT(block, 0, bool) = acts;
    return FL_OK;
}

static void safe(struct fl_block *block)
{
    FL_OUT(block, 0, bool) = false;
}

FL_BLOCK(held) = {
    .abi = FL_ABI,
    .name = "held",
    .summary = "",
    .source = "",
    FL_TABLE(parameter, parameters),
    FL_TABLE(output, outputs),
    .parameters_size = sizeof(struct held),
    .step = step,
    .safe = safe,
};
