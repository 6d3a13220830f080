#define _GNU_SOURCE
#include "device.h"

#include "core/claim.h"
#include "parameter.h"

#include <errno.h>
#include <inttypes.h>
#include <limits.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum {
    LISTEN_MS = 500,              /* at least: from bind() to listen() of the holder */
    LISTEN_POLL_NS = 1000 * 1000, /* there is no event to wait for */
};

static bool names_device(const struct fl_parameter *parameter)
{
    return parameter->kind == FL_KIND_DEVICE || parameter->flags & FL_EXCLUSIVE;
}

bool device_write(const struct fl_block *block, FILE *out)
{
    bool any = false;
    for (uint32_t i = 0; i < block->type->parameter_count; i++) {
        const struct fl_parameter *parameter = &block->type->parameters[i];
        if (!names_device(parameter))
            continue;
        fprintf(out, "%s%s ", any ? ", " : "", parameter->name);
        parameter_write(parameter, block->parameters, out);
        any = true;
    }
    return any;
}

/* A key that is unique on the computer: for a path, the file it leads to; otherwise the type of block and the
 * parameters. */
static void write_key(const struct fl_block *block, FILE *out)
{
    for (uint32_t i = 0; i < block->type->parameter_count; i++) {
        const struct fl_parameter *parameter = &block->type->parameters[i];
        if (parameter->kind != FL_KIND_DEVICE)
            continue;
        const struct fl_device *device = (const void *)((const char *)block->parameters + parameter->offset);
        char *real = realpath(device->path, NULL);
        fputs(real ? real : device->path, out);
        free(real);
        return;
    }
    fprintf(out, "%s ", block->type->name);
    device_write(block, out);
}

static char *text_of(const struct fl_block *block, void (*write_text)(const struct fl_block *block, FILE *out))
{
    char *text = NULL;
    size_t size = 0;
    FILE *out = open_memstream(&text, &size);
    if (!out)
        abort();
    write_text(block, out);
    if (fclose(out) != 0)
        abort();
    return text;
}

static void write_shown(const struct fl_block *block, FILE *out)
{
    device_write(block, out);
}

/* Until the holder has ended, or CLOCK_MONOTONIC is `until_ns`. */
static void wait_for(const struct claim *holder, int64_t until_ns)
{
    int64_t left_ms = (until_ns - fl_now_ns()) / 1000000 + 1; /* each turn takes one of the holder's places */
    struct pollfd gone = {.fd = holder->fd};
    poll(&gone, 1, left_ms > 0 ? (int)left_ms : 0);
    close(holder->fd);
}

static int refuse(struct fl_block *block, pid_t process)
{
    char path[64], command[128] = "";
    snprintf(path, sizeof path, "/proc/%d/cmdline", (int)process);
    FILE *file = process ? fopen(path, "re") : NULL;
    size_t got = file ? fread(command, 1, sizeof command - 1, file) : 0;
    if (file)
        fclose(file);
    for (size_t i = 0; i + 1 < got; i++)
        if (!command[i])
            command[i] = ' ';
    char *device = text_of(block, write_shown);
    if (process)
        fl_fail(block, "%s is held by process %d (%s); only one task may use a device: end that one first", device,
                (int)process, command);
    else /* too many processes wait for it, or the holder is in another container */
        fl_fail(block, "%s is held by another process; only one task may use a device: end that one first", device);
    free(device);
    return FL_FAILED;
}

int device_claim(struct fl_block *block)
{
    struct fl_service *service = block->service;
    struct claim claim;
    bool any = false;
    for (uint32_t i = 0; i < block->type->parameter_count; i++)
        any |= names_device(&block->type->parameters[i]);
    if (!block->type->safe || !any || service->claim_fd > 0)
        return FL_OK;
    char *key = text_of(block, write_key);
    int64_t begun_ns = fl_now_ns(), until_ns = begun_ns + (int64_t)service->patience_ms * 1000000;
    int64_t listening_ns = begun_ns + LISTEN_MS * INT64_C(1000000);
    if (until_ns < listening_ns)
        until_ns = listening_ns;
    int status = FL_FAILED;
    for (bool decided = false; !decided;) {
        bool late = fl_now_ns() >= until_ns;
        enum claim_result result = claim_take("flotilla", key, fl_now_ns() >= listening_ns, &claim);
        decided = true;
        if (result == CLAIM_OURS || result == CLAIM_STRANGERS) {
            service->claim_fd = result == CLAIM_OURS ? claim.fd : 0;
            status = FL_OK;
        } else if (result == CLAIM_ERROR) {
            fl_fail(block, "its device cannot be claimed: %s", strerror(errno));
        } else if (late) {
            if (claim.fd >= 0)
                close(claim.fd);
            refuse(block, claim.process);
        } else {
            decided = false;
            if (result == CLAIM_HELD)
                wait_for(&claim, until_ns);
            else
                nanosleep(&(struct timespec){.tv_nsec = LISTEN_POLL_NS}, NULL);
        }
    }
    free(key);
    return status;
}

void device_release(struct fl_service *service)
{
    if (service->claim_fd > 0)
        close(service->claim_fd);
    service->claim_fd = 0;
}
