/* Plug-in for a loop inside one computer: a gyro's frames into a UART whose output is its own input, and the time from
 * a frame to what comes of it. Both blocks are of one task: they share the times of the frames. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <flotilla/block.h>
#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <termios.h>
#include <unistd.h>

#ifndef TIOCM_LOOP
#define TIOCM_LOOP 0x8000
#endif

#define DEG_S_PER_FRAME 0.001
#define DEG             (3.14159265358979323846 / 180)

enum { FRAMES = 1 << 16, BUCKETS = 100 * 1000 };

static int64_t written_ns[FRAMES];

/* --- frames --- */

struct frames {
    const char *device; /* no fl_device: the driver under test has it to itself */
};

struct frames_state {
    int fd;
    uint32_t count;
};

static const struct fl_parameter frames_parameters[] = {FL_PARAMETER(struct frames, device)};

static int frames_start(struct fl_block *block)
{
    const struct frames *frames = block->parameters;
    struct frames_state *state = block->state;
    int loop = TIOCM_LOOP;
    state->fd = open(frames->device, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (state->fd < 0 || ioctl(state->fd, TIOCMBIS, &loop) < 0)
        return fl_fail(block, "%s: %s", frames->device, strerror(errno));
    return FL_OK;
}

/* Turns to and fro, so that the controller switches each time; how fast says which frame it is. */
static int frames_step(struct fl_block *block)
{
    char frame[32];
    struct frames_state *state = block->state;
    if (block->step < 50 || state->count + 1 >= FRAMES) /* the driver has to open the port */
        return FL_OK;
    state->count++;
    double rate_deg_s = (state->count % 2 ? 1 : -1) * DEG_S_PER_FRAME * state->count;
    int size = snprintf(frame, sizeof frame, "%15.6f   1\r\n", rate_deg_s);
    written_ns[state->count] = fl_now_ns();
    if (write(state->fd, frame, (size_t)size) != size)
        return fl_fail(block, "the port takes no frame");
    return FL_OK;
}

static void frames_terminate(struct fl_block *block)
{
    struct frames_state *state = block->state;
    int loop = TIOCM_LOOP;
    if (state->fd > 0) {
        ioctl(state->fd, TIOCMBIC, &loop);
        close(state->fd);
    }
}

FL_BLOCK(frames) = {
    .abi = FL_ABI,
    .name = "frames",
    FL_TABLE(parameter, frames_parameters),
    .parameters_size = sizeof(struct frames),
    .state_size = sizeof(struct frames_state),
    .start = frames_start,
    .step = frames_step,
    .terminate = frames_terminate,
};

/* --- chain --- */

struct chain {
    const char *file;
};

struct chain_state {
    uint32_t frame, late, histogram[BUCKETS];
};

static const struct fl_parameter chain_parameters[] = {FL_PARAMETER(struct chain, file)};
static const struct fl_port chain_inputs[] = {
    {.name = "rate", .type = FL_DOUBLE, .width = 1, .unit = "rad/s"},
    {.name = "after", .type = FL_BOOLEAN, .width = 1}, /* only to run after it */
};

static int chain_step(struct fl_block *block)
{
    struct chain_state *state = block->state;
    uint32_t frame = (uint32_t)lround(fabs(FL_IN(block, 0, double)) / DEG / DEG_S_PER_FRAME);
    if (frame == state->frame || frame >= FRAMES)
        return FL_OK;
    state->frame = frame;
    int64_t us = (fl_now_ns() - written_ns[frame]) / 1000;
    if (us >= 0 && us < BUCKETS)
        state->histogram[us]++;
    else
        state->late++;
    return FL_OK;
}

static void chain_terminate(struct fl_block *block)
{
    const struct chain *chain = block->parameters;
    const struct chain_state *state = block->state;
    FILE *out = fopen(chain->file, "we");
    if (!out)
        return;
    fprintf(out, "{\"late\": %" PRIu32 ", \"histogram_us\": {", state->late);
    const char *separator = "";
    for (int us = 0; us < BUCKETS; us++) {
        if (state->histogram[us]) {
            fprintf(out, "%s\"%d\": %" PRIu32, separator, us, state->histogram[us]);
            separator = ", ";
        }
    }
    fprintf(out, "}}\n");
    fclose(out);
}

FL_BLOCK(chain) = {
    .abi = FL_ABI,
    .name = "chain",
    FL_TABLE(input, chain_inputs),
    FL_TABLE(parameter, chain_parameters),
    .parameters_size = sizeof(struct chain),
    .state_size = sizeof(struct chain_state),
    .step = chain_step,
    .terminate = chain_terminate,
};
