#define _GNU_SOURCE
#include "watch.h"

#include <errno.h>
#include <flotilla/ring.h>
#include <inttypes.h>
#include <math.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>

enum { RECORDS = 1024 };

struct row {
    uint64_t step;
    int64_t release_ns;
    _Alignas(8) unsigned char values[];
};

struct watch {
    struct fl_ring ring;
    const struct watched *watched;
    size_t count;
    struct row *put, *taken;
    void *memory;
};

static void *zeroed(size_t bytes)
{
    void *memory = aligned_alloc(64, (bytes + 63) / 64 * 64);
    if (!memory)
        abort();
    return memset(memory, 0, bytes);
}

static size_t bytes_of(const struct watched *watched)
{
    return (fl_type_size(watched->type) * watched->width + 7) & ~(size_t)7;
}

struct watch *watch_create(const struct watched *watched, size_t count)
{
    struct watch *watch = zeroed(sizeof *watch);
    size_t bytes = sizeof(struct row);
    for (size_t i = 0; i < count; i++)
        bytes += bytes_of(&watched[i]);
    watch->watched = watched;
    watch->count = count;
    watch->put = zeroed(bytes);
    watch->taken = zeroed(bytes);
    watch->memory = zeroed(fl_ring_bytes(bytes, RECORDS));
    fl_ring_initialize(&watch->ring, watch->memory, bytes, RECORDS);
    return watch;
}

void watch_destroy(struct watch *watch)
{
    if (!watch)
        return;
    free(watch->put);
    free(watch->taken);
    free(watch->memory);
    free(watch);
}

void watch_put(struct watch *watch, uint64_t step, int64_t release_ns, bool wait)
{
    unsigned char *at = watch->put->values;
    watch->put->step = step;
    watch->put->release_ns = release_ns;
    for (size_t i = 0; i < watch->count; i++) {
        memcpy(at, watch->watched[i].signal, fl_type_size(watch->watched[i].type) * watch->watched[i].width);
        at += bytes_of(&watch->watched[i]);
    }
    while (!fl_ring_put(&watch->ring, watch->put) && wait)
        sched_yield();
}

#define PRINT(c_type, format)                                                                                          \
    do {                                                                                                               \
        c_type value;                                                                                                  \
        memcpy(&value, at, sizeof value);                                                                              \
        printf(format, value);                                                                                         \
    } while (0)

/* JSON knows neither NaN nor infinity. */
static void print_real(double value)
{
    if (isfinite(value))
        printf("%.17g", value);
    else
        printf("null");
}

static void print_value(enum fl_type type, const unsigned char *at)
{
    float single;
    double real;
    switch (type) {
    case FL_BOOLEAN:
    case FL_UINT8:
        PRINT(uint8_t, "%" PRIu8);
        break;
    case FL_INT8:
        PRINT(int8_t, "%" PRId8);
        break;
    case FL_INT16:
        PRINT(int16_t, "%" PRId16);
        break;
    case FL_UINT16:
        PRINT(uint16_t, "%" PRIu16);
        break;
    case FL_INT32:
        PRINT(int32_t, "%" PRId32);
        break;
    case FL_UINT32:
        PRINT(uint32_t, "%" PRIu32);
        break;
    case FL_INT64:
        PRINT(int64_t, "%" PRId64);
        break;
    case FL_UINT64:
        PRINT(uint64_t, "%" PRIu64);
        break;
    case FL_SINGLE:
        memcpy(&single, at, sizeof single);
        print_real((double)single);
        break;
    case FL_DOUBLE:
        memcpy(&real, at, sizeof real);
        print_real(real);
        break;
    case FL_TYPES:
        break;
    }
}

int watch_print(struct watch *watch)
{
    while (fl_ring_take(&watch->ring, watch->taken)) {
        const unsigned char *at = watch->taken->values;
        printf("{\"step\": %" PRIu64 ", \"release_ns\": %" PRId64 ", \"lost\": %" PRIu32, watch->taken->step,
               watch->taken->release_ns, atomic_load(&watch->ring.lost));
        for (size_t i = 0; i < watch->count; i++) {
            const struct watched *watched = &watch->watched[i];
            printf(", \"%s\": %s", watched->name, watched->width > 1 ? "[" : "");
            for (uint32_t element = 0; element < watched->width; element++) {
                printf(element ? ", " : "");
                print_value(watched->type, at + element * fl_type_size(watched->type));
            }
            printf(watched->width > 1 ? "]" : "");
            at += bytes_of(watched);
        }
        printf("}\n");
    }
    errno = 0;
    bool failed = fflush(stdout) != 0 || ferror(stdout);
    return !failed ? 0 : errno ? errno : EPIPE;
}
