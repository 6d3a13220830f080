#define _GNU_SOURCE
#include "stream.h"

#include "client.h"
#include "core/service.h"
#include "parameter.h"

#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

enum {
    DRAIN_MS = 20, /* between two looks at what the control thread has copied, which wakes nobody */
    TRIGGERED_ROWS = 1000,
};

/* --- the request --- */

struct parsing {
    struct stream *stream;
    const struct task *task;
    char *reason;
    size_t reason_size;
};

static bool refuse(const struct parsing *parsing, const char *format, ...) __attribute__((format(printf, 2, 3)));
static bool refuse(const struct parsing *parsing, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(parsing->reason, parsing->reason_size, format, arguments);
    va_end(arguments);
    return false;
}

/* The signal's place in the table, where it is added; -1 with the reason. */
static int add_signal(const struct parsing *parsing, const char *name)
{
    struct stream *stream = parsing->stream;
    for (size_t i = 0; i < stream->count; i++)
        if (strcmp(stream->watched[i].name, name) == 0)
            return (int)i;
    if (stream->count == STREAM_SIGNALS) {
        refuse(parsing, "at most %d signals at once", STREAM_SIGNALS);
        return -1;
    }
    struct watched *watched = &stream->watched[stream->count];
    watched->name = name;
    watched->signal =
        task_signal(parsing->task, name, &watched->type, &watched->width, parsing->reason, parsing->reason_size);
    return watched->signal ? (int)stream->count++ : -1;
}

static bool parse_count(const struct parsing *parsing, const char *key, const char *text, uint64_t least,
                        uint64_t *count)
{
    return (read_unsigned(text, count) && *count >= least && *count <= UINT32_MAX) ||
           refuse(parsing, "%s=%s: not a whole number from %" PRIu64 " to %" PRIu32, key, text, least, UINT32_MAX);
}

static bool parse_trigger(const struct parsing *parsing, char *text)
{
    struct stream *stream = parsing->stream;
    char *sign = strpbrk(text, "<>");
    if (!sign || !read_double(sign + 1, &stream->trigger.value) || !isfinite(stream->trigger.value))
        return refuse(parsing, "trigger=%s: not SIGNAL>VALUE or SIGNAL<VALUE", text);
    stream->trigger.below = *sign == '<';
    *sign = '\0';
    int which = add_signal(parsing, text);
    stream->trigger.wanted = true;
    stream->trigger.is_past = true; /* what is there when the client comes is no crossing */
    stream->trigger.which = (size_t)which;
    return which >= 0;
}

static bool parse_word(const struct parsing *parsing, char *word)
{
    struct stream *stream = parsing->stream;
    char *value = strchr(word, '=');
    if (!value) {
        if (strcmp(word, "csv") == 0)
            stream->csv = true;
        else
            return add_signal(parsing, word) >= 0;
        return true;
    }
    *value++ = '\0';
    if (strcmp(word, "every") == 0)
        return parse_count(parsing, word, value, 1, &stream->every);
    if (strcmp(word, "rows") == 0)
        return parse_count(parsing, word, value, 0, &stream->rows);
    if (strcmp(word, "before") == 0) {
        uint64_t before = 0;
        bool good = parse_count(parsing, word, value, 0, &before);
        stream->before = (size_t)before;
        return good;
    }
    if (strcmp(word, "trigger") == 0)
        return parse_trigger(parsing, value);
    return refuse(parsing, "%s: unknown; known are every, rows, csv, trigger and before", word);
}

/* What does not depend on one word alone. */
static bool is_consistent(const struct parsing *parsing)
{
    struct stream *stream = parsing->stream;
    if (!stream->count)
        return refuse(parsing, "no signal is named; `signals` lists them");
    stream->row_bytes = sampler_row_bytes(stream->watched, stream->count);
    if (stream->row_bytes > SCOPE_ROW_BYTES)
        return refuse(parsing,
                      "these signals have %zu bytes, at most %d are copied after a step; name elements: "
                      "BLOCK.PORT[0]",
                      stream->row_bytes, SCOPE_ROW_BYTES);
    if (stream->before && !stream->trigger.wanted)
        return refuse(parsing, "before: there is no trigger");
    if (stream->trigger.wanted && !stream->rows)
        stream->rows = stream->before + TRIGGERED_ROWS;
    if (stream->trigger.wanted && stream->before >= stream->rows)
        return refuse(parsing, "before=%zu leaves no row of %" PRIu64 " for the trigger", stream->before, stream->rows);
    if (stream->before > STREAM_BEFORE_BYTES / stream->row_bytes)
        return refuse(parsing, "before=%zu: at most %zu rows of these signals are held", stream->before,
                      STREAM_BEFORE_BYTES / stream->row_bytes);
    return true;
}

static bool parse(const struct parsing *parsing)
{
    for (char *rest = parsing->stream->request, *word; (word = strsep(&rest, " "));)
        if (*word && !parse_word(parsing, word))
            return false;
    return is_consistent(parsing);
}

/* --- rows --- */

/* False: it was the last one. */
static bool write_row(struct stream *stream, const struct row *row, FILE *out)
{
    (stream->csv ? sampler_write_csv : sampler_write)(stream->sampler, row, out);
    return !stream->rows || --stream->rows;
}

static void hold(struct stream *stream, const struct row *row)
{
    if (!stream->before)
        return;
    memcpy(stream->past + stream->next * stream->row_bytes, row, stream->row_bytes);
    stream->next = (stream->next + 1) % stream->before;
    stream->held += stream->held < stream->before;
}

static bool crosses(struct stream *stream, const struct row *row)
{
    double value = sampler_number(stream->sampler, row, stream->trigger.which);
    bool was_past = stream->trigger.is_past;
    stream->trigger.is_past = stream->trigger.below ? value < stream->trigger.value : value > stream->trigger.value;
    return stream->trigger.is_past && !was_past;
}

/* Write the row, or hold it until the trigger. False: no further one is asked for. */
static bool take_row(struct stream *stream, const struct row *row, FILE *out)
{
    if (!stream->trigger.wanted)
        return write_row(stream, row, out);
    bool full = stream->held == stream->before;
    if (!crosses(stream, row) || !full) {
        hold(stream, row);
        return true;
    }
    stream->trigger.wanted = false;
    for (size_t i = 0; i < stream->before; i++) {
        size_t at = (stream->next + i) % stream->before;
        write_row(stream, (const struct row *)(const void *)(stream->past + at * stream->row_bytes), out);
    }
    return write_row(stream, row, out);
}

/* Send what there is. False at the end. */
static bool send_rows(struct stream *stream, bool stopping)
{
    char *text = NULL;
    size_t length = 0;
    bool more = true;
    FILE *out = open_memstream(&text, &length);
    if (!out)
        return false;
    for (const struct row *row = sampler_take(stream->sampler); row; row = more ? sampler_take(stream->sampler) : NULL)
        more = take_row(stream, row, out);
    fclose(out);
    if (stopping) /* the rows before the end are worth seeing, but nobody waits for this client */
        more = send(stream->fd, text, length, MSG_DONTWAIT | MSG_NOSIGNAL) == (ssize_t)length && more;
    else
        more = client_send(stream->stop_fd, stream->fd, text, length) && more;
    free(text);
    return more;
}

static bool send_head(struct stream *stream)
{
    char *text = NULL;
    size_t length = 0;
    FILE *out = open_memstream(&text, &length);
    if (!out)
        return false;
    fputs("ok\n", out);
    if (stream->csv)
        sampler_write_csv_head(stream->sampler, out);
    fclose(out);
    bool sent = client_send(stream->stop_fd, stream->fd, text, length);
    free(text);
    return sent;
}

static void *run(void *argument)
{
    struct stream *stream = argument;
    struct pollfd waiting[] = {{.fd = stream->stop_fd, .events = POLLIN}, {.fd = stream->fd, .events = POLLIN}};
    bool more = send_head(stream);
    while (more) {
        poll(waiting, 2, DRAIN_MS);
        bool stopping = waiting[0].revents, gone = waiting[1].revents; /* a client has nothing more to say */
        more = !gone && send_rows(stream, stopping) && !stopping;
    }
    scope_detach(stream->slot);
    shutdown(stream->fd, SHUT_RDWR); /* the client need not wait until somebody joins this thread */
    atomic_store(&stream->ended, true);
    return NULL;
}

/* --- its life --- */

static void clear(struct stream *stream)
{
    sampler_destroy(stream->sampler);
    free(stream->past);
    close(stream->fd);
    stream->begun = false;
}

static void join_ended(struct streams *streams)
{
    for (struct stream *stream = streams->all; stream < streams->all + SCOPE_CLIENTS; stream++) {
        if (!stream->begun || !atomic_load(&stream->ended))
            continue;
        pthread_join(stream->thread, NULL);
        clear(stream);
    }
}

static struct stream *unused(struct streams *streams)
{
    for (struct stream *stream = streams->all; stream < streams->all + SCOPE_CLIENTS; stream++)
        if (!stream->begun)
            return stream;
    return NULL;
}

bool stream_begin(struct streams *streams, struct scope *scope, const struct task *task, int fd, int stop_fd,
                  const char *request, char *reason, size_t reason_size)
{
    join_ended(streams);
    struct stream *stream = unused(streams);
    struct parsing parsing = {.stream = stream, .task = task, .reason = reason, .reason_size = reason_size};
    if (!stream)
        return refuse(&parsing, "%d others watch this task, which are all that may", SCOPE_CLIENTS);
    *stream = (struct stream){.fd = fd, .stop_fd = stop_fd, .scope = scope, .every = 1};
    if (strlen(request) >= sizeof stream->request)
        return refuse(&parsing, "the request is longer than %d bytes", STREAM_REQUEST_BYTES - 1);
    memcpy(stream->request, request, strlen(request) + 1);
    if (!parse(&parsing))
        return false;
    stream->past = malloc(stream->before ? stream->before * stream->row_bytes : 1);
    if (!stream->past)
        return refuse(&parsing, "there is no memory for %zu rows", stream->before);
    stream->sampler = sampler_create(stream->watched, stream->count);
    stream->slot = scope_attach(scope, stream->sampler, (uint32_t)stream->every);
    stream->begun = true;
    struct fl_service ordinary = {0};
    int error = stream->slot ? fl_service_thread(&ordinary, &stream->thread, "scope", run, stream) : EAGAIN;
    if (!error)
        return true;
    if (stream->slot)
        scope_detach(stream->slot);
    stream->fd = -1; /* it stays the caller's */
    clear(stream);
    return refuse(&parsing, "no thread for it: %s", strerror(error));
}

void streams_join(struct streams *streams)
{
    for (struct stream *stream = streams->all; stream < streams->all + SCOPE_CLIENTS; stream++) {
        if (!stream->begun)
            continue;
        pthread_join(stream->thread, NULL);
        clear(stream);
    }
}
