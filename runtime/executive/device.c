#define _GNU_SOURCE
#include "device.h"

#include "parameter.h"

#include <errno.h>
#include <inttypes.h>
#include <limits.h>
#include <poll.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

enum {
    WAITING = 128,                /* processes that may wait for one device */
    LISTEN_MS = 50,               /* at least: from bind() to listen() of the holder */
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

/* Keep the end of a long name: that is where names differ. */
static socklen_t address_of(const struct fl_block *block, struct sockaddr_un *address)
{
    char *key = text_of(block, write_key);
    const size_t room = sizeof address->sun_path - 1 - strlen("flotilla/"), length = strlen(key);
    *address = (struct sockaddr_un){.sun_family = AF_UNIX};
    int used = snprintf(address->sun_path + 1, sizeof address->sun_path - 1, "flotilla/%s",
                        key + (length >= room ? length - room + 1 : 0));
    free(key);
    return (socklen_t)(offsetof(struct sockaddr_un, sun_path) + 1 + (size_t)used);
}

/* A listening socket, or -1 with errno: EADDRINUSE where another process has it. */
static int hold(const struct sockaddr_un *address, socklen_t length)
{
    int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (fd < 0 || (bind(fd, (const struct sockaddr *)address, length) == 0 && listen(fd, WAITING) == 0))
        return fd;
    int error = errno;
    close(fd);
    errno = error;
    return -1;
}

/* Wait until the holder has ended, or CLOCK_MONOTONIC is `until_ns`. Returns its process, or 0 where that is unknown.
 */
static pid_t wait_for_holder(const struct sockaddr_un *address, socklen_t length, int64_t until_ns)
{
    struct ucred holder = {0};
    socklen_t size = sizeof holder;
    int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (fd >= 0 && connect(fd, (const struct sockaddr *)address, length) == 0) {
        getsockopt(fd, SOL_SOCKET, SO_PEERCRED, &holder, &size);
        int64_t left_ms = (until_ns - fl_now_ns()) / 1000000 + 1; /* each turn takes one of the holder's places */
        struct pollfd gone = {.fd = fd};
        poll(&gone, 1, left_ms > 0 ? (int)left_ms : 0);
    } else {
        nanosleep(&(struct timespec){.tv_nsec = LISTEN_POLL_NS}, NULL);
    }
    if (fd >= 0)
        close(fd);
    return holder.pid;
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
    struct sockaddr_un address;
    bool any = false;
    for (uint32_t i = 0; i < block->type->parameter_count; i++)
        any |= names_device(&block->type->parameters[i]);
    if (!block->type->safe || !any || service->claim_fd > 0)
        return FL_OK;
    socklen_t length = address_of(block, &address);
    int64_t patience_ms = service->patience_ms > LISTEN_MS ? service->patience_ms : LISTEN_MS;
    int64_t now_ns = fl_now_ns(), until_ns = now_ns + patience_ms * 1000000;
    for (;;) {
        service->claim_fd = hold(&address, length);
        if (service->claim_fd >= 0)
            return FL_OK;
        if (errno != EADDRINUSE)
            return fl_fail(block, "its device cannot be claimed: %s", strerror(errno));
        pid_t process = wait_for_holder(&address, length, until_ns);
        now_ns = fl_now_ns();
        if (now_ns >= until_ns)
            return refuse(block, process);
    }
}

void device_release(struct fl_service *service)
{
    if (service->claim_fd > 0)
        close(service->claim_fd);
    service->claim_fd = 0;
}
