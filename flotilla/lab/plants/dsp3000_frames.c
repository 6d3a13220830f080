/* The other end of a gyro's serial line: a frame of the DSP-3000 with each step. */
#define _DEFAULT_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <flotilla/block.h>
#include <math.h>
#include <string.h>
#include <sys/ioctl.h>
#include <termios.h>
#include <unistd.h>

#ifndef TIOCM_LOOP
#define TIOCM_LOOP 0x8000
#endif

enum { VALUE = 15, FRAME = 21, DECIMALS = 6 };

struct frames {
    const char *device; /* no fl_device: looped back, it is the driver's under test */
    bool loopback;
};

struct state {
    int fd;
    bool open;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct frames, device, .summary = "serial port; 38400 Bd"),
    FL_PARAMETER(struct frames, loopback, .default_value = "false",
                 .summary = "true: the UART's output is its own input, so that a driver on the same port reads it"),
};

enum { RATE, VALID };
static const struct fl_port inputs[] = {
    {.name = "rate_deg_s", .type = FL_DOUBLE, .width = 1, .unit = "°/s", .summary = "clockwise positive"},
    {.name = "valid", .type = FL_BOOLEAN, .width = 1, .summary = "0: the gyro reports a fault"},
};
static const struct fl_port outputs[] = {
    {.name = "lost", .type = FL_UINT32, .width = 1, .summary = "frames for which the line had no room"},
};

/* Raw before the first byte: a line that echoes and is looped back would never fall silent. */
static int set_line(int fd, bool loopback)
{
    int loop = TIOCM_LOOP;
    struct termios raw;
    if (tcgetattr(fd, &raw) < 0)
        return -1;
    cfmakeraw(&raw);
    raw.c_cflag |= CLOCAL | CREAD;
    if (cfsetspeed(&raw, B38400) < 0 || tcsetattr(fd, TCSANOW, &raw) < 0)
        return -1;
    return loopback ? ioctl(fd, TIOCMBIS, &loop) : 0;
}

static int start(struct fl_block *block)
{
    const struct frames *frames = block->parameters;
    struct state *state = block->state;
    state->fd = open(frames->device, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (state->fd < 0)
        return fl_fail(block, "%s: %s", frames->device, strerror(errno));
    state->open = true;
    if (set_line(state->fd, frames->loopback) < 0)
        return fl_fail(block, "%s: %s", frames->device, strerror(errno));
    return FL_OK;
}

/* "%15.6f   %d\r\n", without stdio. */
static void write_frame(double rate_deg_s, bool valid, char frame[FRAME])
{
    int64_t micro = llround(1e6 * fmax(fmin(rate_deg_s, 999999), -999999)), rest = micro < 0 ? -micro : micro;
    memset(frame, ' ', FRAME);
    memcpy(frame + FRAME - 3, valid ? "1\r\n" : "0\r\n", 3);
    char *at = frame + VALUE;
    for (int digit = 0; digit <= DECIMALS || rest; digit++, rest /= 10) {
        if (digit == DECIMALS)
            *--at = '.';
        *--at = (char)('0' + rest % 10);
    }
    if (micro < 0)
        *--at = '-';
}

static int step(struct fl_block *block)
{
    struct state *state = block->state;
    char frame[FRAME];
    write_frame(FL_IN(block, RATE, double), FL_IN(block, VALID, bool), frame);
    FL_OUT(block, 0, uint32_t) += write(state->fd, frame, FRAME) != FRAME;
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    const struct frames *frames = block->parameters;
    const struct state *state = block->state;
    int loop = TIOCM_LOOP;
    if (!state->open)
        return;
    if (frames->loopback)
        ioctl(state->fd, TIOCMBIC, &loop);
    close(state->fd);
}

FL_BLOCK(dsp3000_frames) = {
    .abi = FL_ABI,
    .name = "dsp3000-frames",
    .summary = "a frame of the fibre-optic gyro DSP-3000 into a serial port, with each step",
    .source = "KVH technical manual 54-0215 Rev. C, section 2",
    FL_TABLE(input, inputs),
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct frames),
    .state_size = sizeof(struct state),
    .start = start,
    .step = step,
    .terminate = terminate,
};
