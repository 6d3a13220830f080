#define _GNU_SOURCE
#include "sampler.h"

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
    uint32_t lost; /* rows that had no room before this one */
    _Alignas(8) unsigned char values[];
};

struct sampler {
    struct fl_ring ring;
    const struct watched *watched;
    size_t count, row_bytes;
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

size_t sampler_row_bytes(const struct watched *watched, size_t count)
{
    size_t bytes = sizeof(struct row);
    for (size_t i = 0; i < count; i++)
        bytes += bytes_of(&watched[i]);
    return bytes;
}

struct sampler *sampler_create(const struct watched *watched, size_t count)
{
    struct sampler *sampler = zeroed(sizeof *sampler);
    size_t bytes = sampler_row_bytes(watched, count);
    sampler->watched = watched;
    sampler->count = count;
    sampler->row_bytes = bytes;
    sampler->put = zeroed(bytes);
    sampler->taken = zeroed(bytes);
    sampler->memory = zeroed(fl_ring_bytes(bytes, RECORDS));
    fl_ring_initialize(&sampler->ring, sampler->memory, bytes, RECORDS);
    return sampler;
}

void sampler_destroy(struct sampler *sampler)
{
    if (!sampler)
        return;
    free(sampler->put);
    free(sampler->taken);
    free(sampler->memory);
    free(sampler);
}

void sampler_put(struct sampler *sampler, uint64_t step, int64_t release_ns, bool wait)
{
    unsigned char *at = sampler->put->values;
    sampler->put->step = step;
    sampler->put->release_ns = release_ns;
    sampler->put->lost = atomic_load_explicit(&sampler->ring.lost, memory_order_relaxed);
    for (size_t i = 0; i < sampler->count; i++) {
        memcpy(at, sampler->watched[i].signal, fl_type_size(sampler->watched[i].type) * sampler->watched[i].width);
        at += bytes_of(&sampler->watched[i]);
    }
    while (!fl_ring_put(&sampler->ring, sampler->put) && wait)
        sched_yield();
}

const struct row *sampler_take(struct sampler *sampler)
{
    return fl_ring_take(&sampler->ring, sampler->taken) ? sampler->taken : NULL;
}

#define NUMBER(c_type)                                                                                                 \
    do {                                                                                                               \
        c_type value;                                                                                                  \
        memcpy(&value, at, sizeof value);                                                                              \
        return (double)value;                                                                                          \
    } while (0)

double sampler_number(const struct sampler *sampler, const struct row *row, size_t which)
{
    const unsigned char *at = row->values;
    for (size_t i = 0; i < which; i++)
        at += bytes_of(&sampler->watched[i]);
    switch (sampler->watched[which].type) {
    case FL_BOOLEAN:
    case FL_UINT8:
        NUMBER(uint8_t);
    case FL_INT8:
        NUMBER(int8_t);
    case FL_INT16:
        NUMBER(int16_t);
    case FL_UINT16:
        NUMBER(uint16_t);
    case FL_INT32:
        NUMBER(int32_t);
    case FL_UINT32:
        NUMBER(uint32_t);
    case FL_INT64:
        NUMBER(int64_t);
    case FL_UINT64:
        NUMBER(uint64_t);
    case FL_SINGLE:
        NUMBER(float);
    case FL_DOUBLE:
        NUMBER(double);
    case FL_TYPES:
        break;
    }
    return NAN;
}

#define WRITE(c_type, format)                                                                                          \
    do {                                                                                                               \
        c_type value;                                                                                                  \
        memcpy(&value, at, sizeof value);                                                                              \
        fprintf(out, format, value);                                                                                   \
    } while (0)

static void write_real(double value, const char *not_finite, FILE *out)
{
    if (isfinite(value))
        fprintf(out, "%.17g", value);
    else
        fputs(not_finite, out);
}

/* `not_finite` stands for NaN and infinity, which neither JSON nor a table's cell knows. */
static void write_value(enum fl_type type, const unsigned char *at, const char *not_finite, FILE *out)
{
    float single;
    double real;
    switch (type) {
    case FL_BOOLEAN:
    case FL_UINT8:
        WRITE(uint8_t, "%" PRIu8);
        break;
    case FL_INT8:
        WRITE(int8_t, "%" PRId8);
        break;
    case FL_INT16:
        WRITE(int16_t, "%" PRId16);
        break;
    case FL_UINT16:
        WRITE(uint16_t, "%" PRIu16);
        break;
    case FL_INT32:
        WRITE(int32_t, "%" PRId32);
        break;
    case FL_UINT32:
        WRITE(uint32_t, "%" PRIu32);
        break;
    case FL_INT64:
        WRITE(int64_t, "%" PRId64);
        break;
    case FL_UINT64:
        WRITE(uint64_t, "%" PRIu64);
        break;
    case FL_SINGLE:
        memcpy(&single, at, sizeof single);
        write_real((double)single, not_finite, out);
        break;
    case FL_DOUBLE:
        memcpy(&real, at, sizeof real);
        write_real(real, not_finite, out);
        break;
    case FL_TYPES:
        break;
    }
}

void sampler_write(const struct sampler *sampler, const struct row *row, FILE *out)
{
    const unsigned char *at = row->values;
    fprintf(out, "{\"step\": %" PRIu64 ", \"release_ns\": %" PRId64 ", \"lost\": %" PRIu32, row->step, row->release_ns,
            row->lost);
    for (size_t i = 0; i < sampler->count; i++) {
        const struct watched *watched = &sampler->watched[i];
        fprintf(out, ", \"%s\": %s", watched->name, watched->width > 1 ? "[" : "");
        for (uint32_t element = 0; element < watched->width; element++) {
            fputs(element ? ", " : "", out);
            write_value(watched->type, at + element * fl_type_size(watched->type), "null", out);
        }
        fputs(watched->width > 1 ? "]" : "", out);
        at += bytes_of(watched);
    }
    fputs("}\n", out);
}

void sampler_write_csv_head(const struct sampler *sampler, FILE *out)
{
    fputs("step,release_ns,lost", out);
    for (size_t i = 0; i < sampler->count; i++) {
        const struct watched *watched = &sampler->watched[i];
        for (uint32_t element = 0; element < watched->width; element++) {
            fprintf(out, ",%s", watched->name);
            if (watched->width > 1)
                fprintf(out, "[%" PRIu32 "]", element);
        }
    }
    fputc('\n', out);
}

void sampler_write_csv(const struct sampler *sampler, const struct row *row, FILE *out)
{
    const unsigned char *at = row->values;
    fprintf(out, "%" PRIu64 ",%" PRId64 ",%" PRIu32, row->step, row->release_ns, row->lost);
    for (size_t i = 0; i < sampler->count; i++) {
        const struct watched *watched = &sampler->watched[i];
        for (uint32_t element = 0; element < watched->width; element++) {
            fputc(',', out);
            write_value(watched->type, at + element * fl_type_size(watched->type), "", out);
        }
        at += bytes_of(watched);
    }
    fputc('\n', out);
}
