#define _GNU_SOURCE
#include "tuner.h"

#include "core/service.h"

#include "block.h"
#include "client.h"
#include "status.h"
#include "stream.h"

#include <errno.h>
#include <inttypes.h>
#include <poll.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

enum {
    REQUEST_BYTES = STREAM_REQUEST_BYTES,
    REASON_BYTES = 512,
    QUEUED = 16, /* connections waiting to be served */
};

struct tuner {
    struct change change;
    struct scope scope;
    struct streams streams;
    struct task *task;
    const struct status *status;
    char *path;
    int listen_fd, stop_fd;
    bool started;
    pthread_t thread;
};

struct client {
    int fd;
    uid_t user;
    char request[REQUEST_BYTES];
    char reason[REASON_BYTES]; /* why it was not done */
    FILE *answer;
};

static bool refuse(struct client *client, const char *format, ...) __attribute__((format(printf, 2, 3)));
static bool refuse(struct client *client, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(client->reason, sizeof client->reason, format, arguments);
    va_end(arguments);
    return false;
}

/* --- what is asked --- */

static struct fl_block *find_block(const struct tuner *tuner, struct client *client, const char *name)
{
    const struct task *task = tuner->task;
    for (size_t i = 0; i < task->count; i++)
        if (strcmp(task->blocks[i].block->name, name) == 0)
            return task->blocks[i].block;
    refuse(client, "the task has no block %s; it has ", name);
    for (size_t i = 0; i < task->count; i++) {
        size_t used = strlen(client->reason);
        snprintf(client->reason + used, sizeof client->reason - used, "%s%s", i ? ", " : "",
                 task->blocks[i].block->name);
    }
    return NULL;
}

/* "block.parameter"; NULL with the reason. */
static const struct fl_parameter *find(const struct tuner *tuner, struct client *client, char *name,
                                       struct fl_block **block)
{
    char reason[REASON_BYTES / 2];
    char *dot = strchr(name, '.');
    if (!dot) {
        refuse(client, "%s is not BLOCK.PARAMETER", *name ? name : "nothing");
        return NULL;
    }
    *dot = '\0';
    *block = find_block(tuner, client, name);
    const struct fl_parameter *parameter =
        *block ? parameter_find((*block)->type, dot + 1, reason, sizeof reason) : NULL;
    if (*block && !parameter)
        refuse(client, "block %s: %s", name, reason);
    return parameter;
}

static const struct fl_bounds *bounds_of(const struct fl_block *block, const struct fl_parameter *parameter)
{
    return &block->service->bounds[parameter - block->type->parameters];
}

/* Only small values without memory of their own can be handed to the control thread. Limits of safety have to have
 * bounds. */
static bool tunable(const struct fl_block *block, const struct fl_parameter *parameter)
{
    if (parameter->flags & FL_SAFETY && !bounds_of(block, parameter)->given)
        return false;
    enum fl_kind kind = parameter->kind;
    bool plain = kind == FL_KIND_BOOLEAN || kind == FL_KIND_INTEGER || kind == FL_KIND_UNSIGNED ||
                 kind == FL_KIND_DOUBLE || kind == FL_KIND_CHOICE;
    return plain && parameter->flags & FL_TUNABLE;
}

static bool list(const struct tuner *tuner, struct client *client)
{
    for (size_t i = 0; i < tuner->task->count; i++) {
        const struct fl_block *block = tuner->task->blocks[i].block;
        for (uint32_t p = 0; p < block->type->parameter_count; p++) {
            const struct fl_parameter *parameter = &block->type->parameters[p];
            const struct fl_bounds *bounds = bounds_of(block, parameter);
            double least = bounds->given ? bounds->least : parameter->min;
            double greatest = bounds->given ? bounds->greatest : parameter->max;
            bool unit = parameter->unit && *parameter->unit, limits = least < greatest;
            fprintf(client->answer, "%s.%s: ", block->name, parameter->name);
            parameter_write(parameter, block->parameters, client->answer);
            fprintf(client->answer, "%s%s", unit ? " " : "", unit ? parameter->unit : "");
            if (tunable(block, parameter))
                fprintf(client->answer, ", tunable");
            if (tunable(block, parameter) && limits)
                fprintf(client->answer, ", %g to %g", least, greatest);
            if (parameter->choices)
                fprintf(client->answer, ", %s", parameter->choices);
            fputc('\n', client->answer);
        }
    }
    return true;
}

static bool list_signals(const struct tuner *tuner, struct client *client)
{
    for (size_t i = 0; i < tuner->task->count; i++) {
        const struct fl_block *block = tuner->task->blocks[i].block;
        for (uint32_t p = 0; p < block->out_count; p++) {
            const struct fl_port *port = &block->out_ports[p];
            fprintf(client->answer, "%s.%s %s %" PRIu32 "%s%s\n", block->name, port->name, fl_type_name(port->type),
                    port->width, port->unit && *port->unit ? " " : "", port->unit ? port->unit : "");
        }
    }
    return true;
}

static bool get(const struct tuner *tuner, struct client *client, char *name)
{
    struct fl_block *block;
    const struct fl_parameter *parameter = find(tuner, client, name, &block);
    if (!parameter)
        return false;
    parameter_write(parameter, block->parameters, client->answer);
    fputc('\n', client->answer);
    return true;
}

/* Check and read a value as the task file would, on a copy of the block that is never started. */
static bool judge(struct client *client, const struct fl_block *block, const struct fl_parameter *parameter,
                  const char *text, void *value)
{
    char reason[REASON_BYTES / 2];
    const struct fl_block_type *type = block->type;
    struct fl_block *like = block_create(type, block->name);
    void *parameters = (void *)(uintptr_t)like->parameters;
    memcpy(parameters, block->parameters, type->parameters_size);
    like->period_ns = block->period_ns;
    bool good = parameter_set(like, parameter, parameters, &(struct raw_value){.count = 1, .text = &text}, reason,
                              sizeof reason);
    if (!good) {
        refuse(client, "block %s: parameter %s: %s", block->name, parameter->name, reason);
    } else if (type->configure && type->configure(like) != FL_OK) {
        good = refuse(client, "block %s: %s", block->name, like->service->failure);
    } else {
        memcpy(value, (const char *)parameters + parameter->offset, parameter_size(parameter->kind));
    }
    block_destroy(like);
    return good;
}

/* Wait until the control thread has taken the offered value. False when it never will: the task does not step, or the
 * client has gone. */
static bool await_taken(struct tuner *tuner, struct client *client, uint64_t *step)
{
    int64_t deadline_ns = client_deadline(CLIENT_MS) + 2 * tuner->task->period_ns;
    for (;;) {
        struct pollfd waiting[] = {{0}, {.fd = tuner->change.taken_fd, .events = POLLIN}, {.fd = client->fd}};
        bool ready = client_await(tuner->stop_fd, waiting, 3, deadline_ns);
        if (change_taken(&tuner->change, step))
            return true;
        if (ready && !waiting[2].revents)
            continue;
        if (change_withdraw(&tuner->change))
            return refuse(client, "the task does not step, so nothing was changed");
        poll(&waiting[1], 1, -1); /* it is being taken at this moment */
    }
}

/* Refuse a value outside the bounds of the task file, and a limit of safety that nobody has confirmed. */
static bool permitted(struct client *client, const struct fl_block *block, const struct fl_parameter *parameter,
                      const void *value, const char *text, const char *confirmed)
{
    const struct fl_bounds *bounds = bounds_of(block, parameter);
    double wanted = bounds->given ? parameter_number(parameter->kind, value) : 0;
    if (bounds->given && (wanted < bounds->least || wanted > bounds->greatest))
        return refuse(client, "block %s: parameter %s: %s is outside %g to %g, its bounds in the task file",
                      block->name, parameter->name, text, bounds->least, bounds->greatest);
    if (!(parameter->flags & FL_SAFETY))
        return true;
    char *old = NULL;
    size_t length = 0;
    FILE *out = open_memstream(&old, &length);
    if (!out)
        abort();
    parameter_write(parameter, block->parameters, out);
    fclose(out);
    bool good = confirmed && strcmp(confirmed, old) == 0;
    if (!good)
        refuse(client, "%s.%s is a limit of safety: %s → %s; confirm it", block->name, parameter->name, old, text);
    free(old);
    return good;
}

static bool set(struct tuner *tuner, struct client *client, char *name, const char *text, const char *confirmed)
{
    unsigned char value[CHANGE_BYTES];
    uint64_t step;
    struct fl_block *block;
    const struct fl_parameter *parameter = find(tuner, client, name, &block);
    if (!parameter)
        return false;
    if (parameter->flags & FL_SAFETY && !tunable(block, parameter))
        return refuse(client, "block %s: parameter %s is a limit of safety, and the task file gives it no bounds",
                      block->name, parameter->name);
    if (!tunable(block, parameter))
        return refuse(client, "block %s: parameter %s cannot be set while the task runs", block->name, parameter->name);
    if (!judge(client, block, parameter, text, value) || !permitted(client, block, parameter, value, text, confirmed))
        return false;
    fprintf(client->answer, "%s.%s: ", block->name, parameter->name);
    parameter_write(parameter, block->parameters, client->answer);
    char *place = (char *)(uintptr_t)block->parameters + parameter->offset;
    change_offer(&tuner->change, place, value, parameter_size(parameter->kind));
    if (!await_taken(tuner, client, &step))
        return false;
    fputs(" → ", client->answer);
    parameter_write(parameter, block->parameters, client->answer);
    fprintf(client->answer, " from step %" PRIu64 " on\n", step);
    return true;
}

static bool send_status(const struct tuner *tuner, struct client *client, bool json)
{
    status_write(tuner->status, json, client->answer);
    return true;
}

/* The client is a stream's from then on. */
static bool watch(struct tuner *tuner, struct client *client, const char *request)
{
    if (!stream_begin(&tuner->streams, &tuner->scope, tuner->task, client->fd, tuner->stop_fd, request, client->reason,
                      sizeof client->reason))
        return false;
    client->fd = -1;
    return true;
}

static bool obey(struct tuner *tuner, struct client *client)
{
    char *rest = client->request, *verb = strsep(&rest, " ");
    if (strcmp(verb, "watch") == 0 && rest)
        return watch(tuner, client, rest);
    char *name = strsep(&rest, " ");
    if (strcmp(verb, "list") == 0 && !name)
        return list(tuner, client);
    if (strcmp(verb, "get") == 0 && name && !rest)
        return get(tuner, client, name);
    if (strcmp(verb, "set") == 0 && name && rest)
        return set(tuner, client, name, rest, NULL);
    char *old = strcmp(verb, "confirm") == 0 ? strsep(&rest, " ") : NULL;
    if (name && old && rest)
        return set(tuner, client, name, rest, old);
    if (strcmp(verb, "signals") == 0 && !name)
        return list_signals(tuner, client);
    if (strcmp(verb, "status") == 0 && (!name || (strcmp(name, "json") == 0 && !rest)))
        return send_status(tuner, client, name);
    return refuse(client, "unknown request; known are list, get BLOCK.PARAMETER, set BLOCK.PARAMETER VALUE, confirm "
                          "BLOCK.PARAMETER OLD VALUE, status, "
                          "status json, signals, watch SIGNAL...");
}

/* --- clients --- */

static void serve_client(struct tuner *tuner, struct client *client)
{
    char *text = NULL;
    size_t length = 0;
    client->answer = open_memstream(&text, &length);
    if (!client->answer)
        return;
    if (client_receive(tuner->stop_fd, client->fd, client->request, sizeof client->request)) {
        bool setting = strncmp(client->request, "set", 3) == 0 || strncmp(client->request, "confirm", 7) == 0;
        fputs("ok\n", client->answer);
        bool done = obey(tuner, client);
        fflush(client->answer);
        if (done && setting)
            fprintf(stderr, "%sflotilla: %s: user %u: %s", fl_priority(FL_INFO), tuner->task->name,
                    (unsigned)client->user, text + 3);
        if (!done && fseek(client->answer, 0, SEEK_SET) == 0)
            fprintf(client->answer, "error\n%s\n", client->reason);
        fflush(client->answer);
        if (client->fd >= 0)
            client_send(tuner->stop_fd, client->fd, text, length);
    }
    fclose(client->answer);
    free(text);
}

static void *serve(void *argument)
{
    struct tuner *tuner = argument;
    struct pollfd waiting[] = {{0}, {.fd = tuner->listen_fd, .events = POLLIN}};
    while (client_await(tuner->stop_fd, waiting, 2, CLIENT_FOR_EVER)) {
        struct ucred peer = {.uid = (uid_t)-1};
        struct client client = {.fd = accept4(tuner->listen_fd, NULL, NULL, SOCK_CLOEXEC)};
        if (client.fd < 0) {
            if (errno != EAGAIN) /* no descriptor or no memory is left, which may pass */
                client_await(tuner->stop_fd, waiting, 1, client_deadline(CLIENT_MS));
            continue;
        }
        getsockopt(client.fd, SOL_SOCKET, SO_PEERCRED, &peer, &(socklen_t){sizeof peer});
        client.user = peer.uid;
        serve_client(tuner, &client);
        if (client.fd >= 0)
            close(client.fd);
    }
    return NULL;
}

/* --- its life --- */

/* Whether there is a socket at the path to which nobody listens any more. */
static bool left_behind(const struct sockaddr_un *address)
{
    struct stat file;
    if (lstat(address->sun_path, &file) < 0 || !S_ISSOCK(file.st_mode))
        return false;
    int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    bool dead = fd >= 0 && connect(fd, (const struct sockaddr *)address, sizeof *address) < 0 && errno == ECONNREFUSED;
    if (fd >= 0)
        close(fd);
    return dead;
}

static int listening(const char *path)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (strlen(path) >= sizeof address.sun_path) {
        errno = ENAMETOOLONG;
        return -1;
    }
    memcpy(address.sun_path, path, strlen(path) + 1);
    int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    if (fd < 0)
        return -1;
    if (left_behind(&address))
        unlink(path);
    if (fchmod(fd, 0660) == 0 /* before it has a name; the umask says whether the group may */
        && bind(fd, (const struct sockaddr *)&address, sizeof address) == 0 && listen(fd, QUEUED) == 0)
        return fd;
    int error = errno;
    close(fd);
    errno = error;
    return -1;
}

struct tuner *tuner_create(const char *path, struct task *task)
{
    struct tuner *tuner = aligned_alloc(_Alignof(struct tuner), sizeof *tuner);
    if (!tuner)
        abort();
    *tuner = (struct tuner){.task = task, .path = strdup(path)};
    tuner->listen_fd = listening(path);
    if (tuner->listen_fd < 0) {
        fprintf(stderr, "%sflotilla: %s: %s: parameters cannot be set while it runs\n", fl_priority(FL_WARNING), path,
                errno == EADDRINUSE ? "it exists, and is another task's socket or not a socket" : strerror(errno));
        free(tuner->path);
        free(tuner);
        return NULL;
    }
    tuner->stop_fd = eventfd(0, EFD_CLOEXEC);
    if (!tuner->path || tuner->stop_fd < 0 || change_initialize(&tuner->change) < 0)
        abort();
    return tuner;
}

void tuner_destroy(struct tuner *tuner)
{
    if (!tuner)
        return;
    tuner_stop(tuner);
    unlink(tuner->path);
    close(tuner->listen_fd);
    close(tuner->stop_fd);
    change_clear(&tuner->change);
    free(tuner->path);
    free(tuner);
}

int tuner_start(struct tuner *tuner, const struct status *status)
{
    struct fl_service ordinary = {0};
    tuner->status = status;
    int error = fl_service_thread(&ordinary, &tuner->thread, "tuner", serve, tuner);
    tuner->started = !error;
    return error;
}

struct change *tuner_change(struct tuner *tuner)
{
    return &tuner->change;
}

struct scope *tuner_scope(struct tuner *tuner)
{
    return &tuner->scope;
}

void tuner_stop(struct tuner *tuner)
{
    if (!tuner->started)
        return;
    eventfd_write(tuner->stop_fd, 1);
    pthread_join(tuner->thread, NULL);
    streams_join(&tuner->streams);
    tuner->started = false;
}
