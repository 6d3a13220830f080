/* What a block is: the interface between a block and the executive that runs it.
 *
 * A block type is a constant `struct fl_block_type`, announced by FL_BLOCK. It has typed ports, typed parameters and
 * a state, and holds nothing else: no globals, so that one task can use it twice. docs/blocks.md has a worked example.
 *
 * Life of a block:
 *   configure    ports that depend on parameters; also on the development computer, so it touches no device
 *   start        opens devices, allocates (fl_allocate), starts a driver thread; may block, may fail
 *   initialize   sets state and outputs as of time zero; not timed
 *   step         once each period of the block, in real time: no allocation, no call that may block
 *   await        where the block may be a task's `trigger`: waits, in real time, for what the next step shall take
 *   safe         an actuator's outputs go to their reset state; in real time, at any moment after start, in any thread,
 *                also in a signal handler while a step was left halfway: only what signal-safety(7) allows
 *   terminate    outputs to their reset state, devices closed; also after a start that failed halfway
 *
 * configure, start, initialize and step return 0, or FL_FAILED after fl_fail() has said why; step also after fl_end().
 */
#ifndef FLOTILLA_BLOCK_H
#define FLOTILLA_BLOCK_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Changes whenever a structure of this header does. A plug-in of another version is refused. */
#define FL_ABI 3u

enum { FL_OK = 0, FL_FAILED = -1 };

/* Types of signals: Simulink's, and the two 64-bit integers. A boolean takes one byte, 0 or 1. */
enum fl_type {
    FL_BOOLEAN,
    FL_INT8,
    FL_UINT8,
    FL_INT16,
    FL_UINT16,
    FL_INT32,
    FL_UINT32,
    FL_INT64,
    FL_UINT64,
    FL_SINGLE,
    FL_DOUBLE,
    FL_TYPES
};

size_t fl_type_size(enum fl_type type);      /* bytes of one element */
const char *fl_type_name(enum fl_type type); /* Simulink's name: "double", "uint8", ... */
int fl_type_named(const char *name);         /* the type of that name, or -1 */

/* --- ports --- */

enum {
    FL_OPTIONAL = 1u << 0, /* input: may stay without a wire, and then reads zero */
    /* input: reads the source's value of the previous step, because the block runs before its source; so it may close
     * a loop */
    FL_DELAYED = 1u << 1,
};

struct fl_port {
    const char *name;
    enum fl_type type;
    uint32_t width; /* elements, at least 1 */
    unsigned flags;
    const char *unit; /* SI, "" or NULL where there is none */
    const char *summary;
};

/* --- parameters --- */

/* Values of these C types can be parameters; the type of the member decides how a task file's value is read. */
struct fl_reals {
    size_t count;
    const double *value;
};
struct fl_texts {
    size_t count;
    const char *const *value;
};
/* A device that one block has to itself: two blocks of a task on one are an error, and two tasks if the type has
 * `safe`.
 */
struct fl_device {
    const char *path;
};

enum fl_kind {
    FL_KIND_BOOLEAN,  /* bool */
    FL_KIND_INTEGER,  /* int64_t */
    FL_KIND_REAL,     /* double */
    FL_KIND_TEXT,     /* const char * */
    FL_KIND_REALS,    /* struct fl_reals: a list, or one number */
    FL_KIND_TEXTS,    /* struct fl_texts: a list, or one text */
    FL_KIND_CHOICE,   /* int: the index among `choices` */
    FL_KIND_DEVICE,   /* struct fl_device */
    FL_KIND_UNSIGNED, /* uint64_t */
};

enum {
    /* may be set while the task runs, between two steps: `step` reads it where it uses it. Not for texts and lists, and
     * not for what start, initialize or a driver's thread reads. */
    FL_TUNABLE = 1u << 0,
    /* names a device, such as a board by its address, alone or together with the others that have this flag: one block
     * of this type may have it, in one task of the computer if the type has `safe` */
    FL_EXCLUSIVE = 1u << 1,
    /* a time in seconds (double) after which the actuator's outputs go to their reset state without a new command; once
     * no step of the task has ended for so long, but at least for five periods, it is ended with outputs made safe */
    FL_ACTUATOR_TIMEOUT = 1u << 2,
};

struct fl_parameter {
    const char *name;
    enum fl_kind kind;
    size_t offset; /* of the member in the structure of parameters */
    unsigned flags;
    const char *fallback; /* the value when the task file has none, written as there; NULL: required */
    double min, max;      /* of numbers and of each in a list, both inclusive; equal: no limit */
    const char *choices;  /* names, separated by '|' */
    const char *unit;
    const char *summary;
};

/* A parameter of the structure `type`: FL_PARAMETER(struct gain, factor, .fallback = "1", .summary = "..."). */
#define FL_PARAMETER(type, member, ...)                                                                                \
    {.name = #member,                                                                                                  \
     .kind = _Generic(((type *)NULL)->member,                                                                          \
         bool: FL_KIND_BOOLEAN,                                                                                        \
         int64_t: FL_KIND_INTEGER,                                                                                     \
         uint64_t: FL_KIND_UNSIGNED,                                                                                   \
         double: FL_KIND_REAL,                                                                                         \
         const char *: FL_KIND_TEXT,                                                                                   \
         struct fl_reals: FL_KIND_REALS,                                                                               \
         struct fl_texts: FL_KIND_TEXTS,                                                                               \
         int: FL_KIND_CHOICE,                                                                                          \
         struct fl_device: FL_KIND_DEVICE),                                                                            \
     .offset = offsetof(type, member),                                                                                 \
     __VA_ARGS__}

/* --- an instance --- */

struct fl_block;
struct fl_service; /* the executive's side */

struct fl_block {
    const struct fl_block_type *type;
    const char *name;       /* in the task */
    const void *parameters; /* the structure that the type's parameters describe */
    void *state;            /* state_size bytes, zero at start */

    /* Ports in the order of the type's tables, then those that `configure` added. */
    const struct fl_port *in_ports, *out_ports;
    uint32_t in_count, out_count;
    const void *const *in; /* in[i]: the elements that the wire carries now */
    void *const *out;

    int64_t period_ns;  /* of this block: the task's times `every` */
    int64_t release_ns; /* when this step was due, CLOCK_MONOTONIC; the same for all blocks of a step */
    uint64_t step;      /* steps of this block before this one */

    /* From the release of this block's step before to this one's: what a step integrates over. It is exactly period_ns
     * while no step was left out or triggered off time, and in the first step; never negative, and FL_LONGEST_INTERVAL
     * periods at most, so that what was stopped for long goes on without a jump. */
    int64_t interval_ns;

    struct fl_service *service;
};

enum { FL_LONGEST_INTERVAL = 10 }; /* periods */

/* The interval in seconds. */
static inline double fl_interval_s(const struct fl_block *block)
{
    return 1e-9 * (double)block->interval_ns;
}

/* The one value of a scalar port. */
#define FL_IN(block, port, c_type)  (*(const c_type *)(block)->in[port])
#define FL_OUT(block, port, c_type) (*(c_type *)(block)->out[port])

/* Memory that lives as long as the block, zeroed and aligned for any type; NULL after fl_fail(). Not in a step. */
void *fl_allocate(struct fl_block *block, size_t bytes);

/* Says why something failed, as printf does, and returns FL_FAILED. In a step too: it only stores. */
int fl_fail(struct fl_block *block, const char *format, ...) __attribute__((format(printf, 2, 3)));

/* Says why the task has come to its end in good order: outputs go to their reset state, and it is not started again.
 * For `return fl_end(...)` in a step; it only stores, too. */
int fl_end(struct fl_block *block, const char *format, ...) __attribute__((format(printf, 2, 3)));

/* A line for the journal, from anywhere but a step. */
void fl_log(struct fl_block *block, const char *format, ...) __attribute__((format(printf, 2, 3)));

/* Add a port from `configure`. The strings must live as long as the block: constants, or fl_allocate()'s. */
int fl_add_input(struct fl_block *block, struct fl_port port);
int fl_add_output(struct fl_block *block, struct fl_port port);

/* Whether the task file wires an input, which FL_OPTIONAL ones may be without. From `start` on. */
bool fl_wired(const struct fl_block *block, uint32_t input);

/* CLOCK_MONOTONIC in nanoseconds. */
int64_t fl_now_ns(void);

/* --- a type --- */

struct fl_block_type {
    uint32_t abi; /* FL_ABI */
    const char *name;
    const char *summary;
    const char *source; /* where its behaviour is written down: a manual, a standard, a paper's section */
    const struct fl_port *inputs, *outputs;
    uint32_t input_count, output_count;
    const struct fl_parameter *parameters;
    uint32_t parameter_count;
    size_t parameters_size, state_size;
    int (*configure)(struct fl_block *block);
    int (*start)(struct fl_block *block);
    int (*initialize)(struct fl_block *block);
    int (*step)(struct fl_block *block);
    /* Until something came, or CLOCK_MONOTONIC is `until_ns`: when it came, or 0 if nothing did. The step has just
     * that: it takes nothing newer than what released it. */
    int64_t (*await)(struct fl_block *block, int64_t until_ns);
    void (*safe)(struct fl_block *block);
    void (*terminate)(struct fl_block *block);
};

#define FL_TABLE(name, array) .name##s = (array), .name##_count = sizeof(array) / sizeof((array)[0])

/* Announce a type, once for each: FL_BLOCK(gain) = {.abi = FL_ABI, .name = "gain", ...};
 * In a program the executive finds it by itself; in a shared object (a plug-in) too, through fl_blocks(). */
#define FL_BLOCK(identifier)                                                                                           \
    static const struct fl_block_type fl_type_##identifier;                                                            \
    __attribute__((used,                                                                                               \
                   section("flotilla_blocks"))) static const struct fl_block_type *const fl_announced_##identifier =   \
        &fl_type_##identifier;                                                                                         \
    static const struct fl_block_type fl_type_##identifier

extern const struct fl_block_type *const __start_flotilla_blocks[] __attribute__((visibility("hidden"), weak));
extern const struct fl_block_type *const __stop_flotilla_blocks[] __attribute__((visibility("hidden"), weak));

/* The types that this program or plug-in announces. */
__attribute__((weak, visibility("default"))) const struct fl_block_type *const *fl_blocks(size_t *count);
__attribute__((weak, visibility("default"))) const struct fl_block_type *const *fl_blocks(size_t *count)
{
    /* Ends of one array, which the linker makes. NOLINTNEXTLINE(clang-analyzer-security.PointerSub) */
    *count = (size_t)(__stop_flotilla_blocks - __start_flotilla_blocks);
    return __start_flotilla_blocks;
}

#endif
