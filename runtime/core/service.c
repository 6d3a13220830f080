/* The functions that blocks and their drivers call: memory, failures, ports, types, threads. */
#define _GNU_SOURCE
#include "service.h"

#include <sched.h>
#include <semaphore.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

static const struct {
    const char *name;
    size_t size;
} types[FL_TYPES] = {
    [FL_BOOLEAN] = {"boolean", 1}, [FL_INT8] = {"int8", 1},     [FL_UINT8] = {"uint8", 1},   [FL_INT16] = {"int16", 2},
    [FL_UINT16] = {"uint16", 2},   [FL_INT32] = {"int32", 4},   [FL_UINT32] = {"uint32", 4}, [FL_INT64] = {"int64", 8},
    [FL_UINT64] = {"uint64", 8},   [FL_SINGLE] = {"single", 4}, [FL_DOUBLE] = {"double", 8},
};

size_t fl_type_size(enum fl_type type)
{
    return types[type].size;
}

const char *fl_type_name(enum fl_type type)
{
    return types[type].name;
}

int fl_type_named(const char *name)
{
    for (int type = 0; type < FL_TYPES; type++)
        if (strcmp(types[type].name, name) == 0)
            return type;
    return -1;
}

void *fl_allocate(struct fl_block *block, size_t bytes)
{
    size_t rounded = FL_CACHE_LINE + (bytes + FL_CACHE_LINE - 1) / FL_CACHE_LINE * FL_CACHE_LINE;
    struct fl_memory *memory =
        bytes < SIZE_MAX - 2 * (size_t)FL_CACHE_LINE ? aligned_alloc(FL_CACHE_LINE, rounded) : NULL;
    if (!memory) {
        fl_fail(block, "no memory for %zu bytes", bytes);
        return NULL;
    }
    memset(memory, 0, rounded);
    memory->next = block->service->memory;
    block->service->memory = memory;
    return (char *)memory + FL_CACHE_LINE;
}

int fl_fail(struct fl_block *block, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(block->service->failure, sizeof block->service->failure, format, arguments);
    va_end(arguments);
    return FL_FAILED;
}

int fl_end(struct fl_block *block, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(block->service->failure, sizeof block->service->failure, format, arguments);
    va_end(arguments);
    block->service->ended = true;
    return FL_FAILED;
}

void fl_not_safe(struct fl_block *block, const char *reason)
{
    const char *none = NULL;
    atomic_compare_exchange_strong(&block->service->not_safe, &none, reason);
}

bool fl_may_act(struct fl_block *block, bool off)
{
    atomic_int *wait = &block->service->wait;
    if (atomic_load_explicit(wait, memory_order_relaxed) == FL_WAIT_NOT)
        return true;
    atomic_store_explicit(wait, off ? FL_WAIT_NOT : FL_WAITS, memory_order_relaxed);
    return off;
}

bool fl_wired(const struct fl_block *block, uint32_t input)
{
    return block->service->wired[input];
}

bool fl_given(const struct fl_block *block, uint32_t parameter)
{
    return block->service->given[parameter];
}

static bool to_journal;

void fl_priority_begin(void)
{
    struct stat stream;
    char found[64];
    const char *journal = getenv("JOURNAL_STREAM"); /* systemd.exec(5) */
    if (!journal || fstat(STDERR_FILENO, &stream) < 0)
        return;
    snprintf(found, sizeof found, "%ju:%ju", (uintmax_t)stream.st_dev, (uintmax_t)stream.st_ino);
    to_journal = strcmp(journal, found) == 0;
}

const char *fl_priority(int priority)
{
    if (!to_journal)
        return "";
    return priority <= FL_ERROR ? "<3>" : priority == FL_WARNING ? "<4>" : "<6>";
}

static void write_line(const struct fl_block *block, int priority, const char *format, va_list arguments)
{
    char line[256];
    vsnprintf(line, sizeof line, format, arguments);
    fprintf(stderr, "%s%s: %s\n", fl_priority(priority), block->name, line);
}

void fl_log(struct fl_block *block, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    write_line(block, FL_INFO, format, arguments);
    va_end(arguments);
}

void fl_warn(struct fl_block *block, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    write_line(block, FL_WARNING, format, arguments);
    va_end(arguments);
}

static int add_port(struct fl_block *block, struct fl_port **ports, uint32_t *count, struct fl_port port)
{
    struct fl_port *more = fl_allocate(block, sizeof port * (*count + 1));
    if (!more)
        return FL_FAILED;
    if (*ports)
        memcpy(more, *ports, sizeof port * *count);
    more[(*count)++] = port;
    *ports = more;
    return FL_OK;
}

int fl_add_input(struct fl_block *block, struct fl_port port)
{
    int result = add_port(block, &block->service->in_ports, &block->in_count, port);
    block->in_ports = block->service->in_ports;
    return result;
}

bool fl_output_possible(const struct fl_port *port)
{
    return !(port->flags & FL_REFUSALS) || (port->type == FL_UINT32 && port->width == 1);
}

int fl_add_output(struct fl_block *block, struct fl_port port)
{
    if (!fl_output_possible(&port))
        return fl_fail(block, "output %s counts refusals and is not one uint32", port.name);
    int result = add_port(block, &block->service->out_ports, &block->out_count, port);
    block->out_ports = block->service->out_ports;
    return result;
}

enum { HANDLERS_STACK_BYTES = 32 * 1024 }; /* frames of several handlers, and what `safe` needs */

void *fl_service_enter(void *(*enter)(void *), void *argument)
{
    unsigned char reserve[HANDLERS_STACK_BYTES]; /* at the far end of the stack from where that overflows */
    stack_t before;
    sigaltstack(&(stack_t){.ss_sp = reserve, .ss_size = sizeof reserve}, &before);
    void *result = enter(argument);
    sigaltstack(&before, NULL);
    return result;
}

struct starting {
    void *(*enter)(void *);
    void *argument;
    sem_t taken;
};

static void *enter_thread(void *argument)
{
    struct starting *starting = argument;
    void *(*enter)(void *) = starting->enter;
    void *context = starting->argument;
    sem_post(&starting->taken); /* `starting` must not be used after this */
    return fl_service_enter(enter, context);
}

int fl_service_thread(struct fl_service *service, pthread_t *thread, const char *name, void *(*enter)(void *),
                      void *argument)
{
    pthread_attr_t attributes;
    struct starting starting = {enter, argument, {{0}}};
    size_t stack = 0;
    int error = pthread_attr_init(&attributes);
    if (error)
        return error;
    if (pthread_attr_getstacksize(&attributes, &stack) == 0)
        pthread_attr_setstacksize(&attributes, stack + HANDLERS_STACK_BYTES);
    sem_init(&starting.taken, 0, 0);
    if (service->priority) {
        pthread_attr_setinheritsched(&attributes, PTHREAD_EXPLICIT_SCHED);
        pthread_attr_setschedpolicy(&attributes, SCHED_FIFO);
        pthread_attr_setschedparam(&attributes, &(struct sched_param){.sched_priority = service->priority});
    }
    error = pthread_create(thread, &attributes, enter_thread, &starting);
    pthread_attr_destroy(&attributes);
    if (!error) {
        while (sem_wait(&starting.taken) < 0)
            continue; /* interrupted */
        char shown[16];
        snprintf(shown, sizeof shown, "%s", name);
        pthread_setname_np(*thread, shown);
    }
    sem_destroy(&starting.taken);
    return error;
}
