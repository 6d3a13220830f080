/* What a block is: the interface between a block and the executive that runs it.
 *
 * A block type is a constant `struct fl_block_type`, announced by FL_BLOCK. It has typed ports, typed parameters and a
 * state. It has no globals, so a task can use it twice. docs/how-to/blocks.md has a worked example.
 *
 * Life of a block:
 *   configure    adds ports that depend on parameters; also runs on the development computer, so it touches no device
 *   start        opens devices, allocates (fl_allocate), starts a driver thread; may block, may fail
 *   initialize   sets state and outputs for time zero; not timed
 *   step         once each period of the block, in real time: no allocation, no call that may block
 *   await        where the block may be a task's `trigger`: waits, in real time, for the input of the next step
 *   safe         brings an actuator's outputs to their reset state, or says by fl_not_safe() that it could not; in real
 *                time, at any moment after start, in any thread, also in a signal handler that interrupts a step: only
 *                what signal-safety(7) allows
 *   terminate    outputs to their reset state, devices closed; also after a start that failed halfway
 *
 * configure, start, initialize and step return 0, or FL_FAILED after fl_fail() was given the reason; step also after
 * fl_end().
 */
#ifndef FLOTILLA_BLOCK_H
#define FLOTILLA_BLOCK_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Changes with each structure of this header. A plug-in built for another version is refused. */
#define FL_ABI 3u

enum { FL_OK = 0, FL_FAILED = -1 };

/* Types of signals: those of Simulink, and the two 64-bit integers. A boolean takes one byte, 0 or 1. */
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
    FL_OPTIONAL = 1u << 0, /* input: needs no wire, and reads zero without one */
    /* input: reads the source's value of the previous step, so it may close a loop of wires */
    FL_DELAYED = 1u << 1,
    /* output, uint32 of width 1: counts what others sent and the block refused; the task's status names it */
    FL_REFUSALS = 1u << 2,
};

struct fl_port {
    const char *name;
    enum fl_type type;
    uint32_t width; /* elements, at least 1 */
    unsigned flags;
    const char *unit; /* SI; "" or NULL: none */
    const char *summary;
};

/* --- parameters --- */

/* Parameters have one of these C types; the type of the member decides how the value in a task file is read. */
struct fl_doubles {
    size_t count;
    const double *value;
};
struct fl_strings {
    size_t count;
    const char *const *value;
};
/* A device for exclusive use: two blocks of a task on one device are an error, and two tasks too if the type has
 * `safe`. */
struct fl_device {
    const char *path;
};

enum fl_kind {
    FL_KIND_BOOLEAN,  /* bool */
    FL_KIND_INTEGER,  /* int64_t */
    FL_KIND_DOUBLE,   /* double */
    FL_KIND_STRING,   /* const char * */
    FL_KIND_DOUBLES,  /* struct fl_doubles: a list, or one number */
    FL_KIND_STRINGS,  /* struct fl_strings: a list, or one string */
    FL_KIND_CHOICE,   /* int: the index among `choices` */
    FL_KIND_DEVICE,   /* struct fl_device */
    FL_KIND_UNSIGNED, /* uint64_t */
};

enum {
    /* may be set while the task runs, between two steps: `step` reads the parameter where it uses it. Not for strings
       and lists, and not for what start, initialize or a thread of the block reads. */
    FL_TUNABLE = 1u << 0,
    /* names a device, such as a board by its address, alone or together with the other parameters that have this flag:
       one block of this type may have it, in one task of the computer if the type has `safe` */
    FL_EXCLUSIVE = 1u << 1,
    /* a time in seconds (double) after which the actuator's outputs go to their reset state without a new command. When
       no step of the task has ended for this long, and for at least five periods, the task is ended with outputs safe
     */
    FL_ACTUATOR_TIMEOUT = 1u << 2,
    /* a number that limits what an actuator may do: a greatest speed, a margin, a time-out. With FL_TUNABLE: it is set
       while the task runs only within the bounds that the task file gives it, and only by who confirms the old and the
       new value */
    FL_SAFETY = 1u << 3,
    /* names what the task needs a permission for, whatever its value: a CAN interface (a string), I/O ports that are
       driven after ioperm(2), or a camera. The service of the task gets the permission because of this flag. */
    FL_CAN_INTERFACE = 1u << 4,
    FL_IO_PORTS = 1u << 5,
    FL_CAMERA = 1u << 6,
};

struct fl_parameter {
    const char *name;
    enum fl_kind kind;
    size_t offset; /* of the member in the structure of parameters */
    unsigned flags;
    const char *default_value; /* used when the task file gives no value, written as there; NULL: required */
    double min, max;           /* of numbers and of each in a list, both inclusive; equal: no limit */
    const char *choices;       /* names, separated by '|' */
    const char *unit;
    const char *summary;
};

/* A parameter of the structure `type`: FL_PARAMETER(struct gain, factor, .default_value = "1", .summary = "..."). */
#define FL_PARAMETER(type, member, ...)                                                                                \
    {.name = #member,                                                                                                  \
     .kind = _Generic(((type *)NULL)->member,                                                                          \
         bool: FL_KIND_BOOLEAN,                                                                                        \
         int64_t: FL_KIND_INTEGER,                                                                                     \
         uint64_t: FL_KIND_UNSIGNED,                                                                                   \
         double: FL_KIND_DOUBLE,                                                                                       \
         const char *: FL_KIND_STRING,                                                                                 \
         struct fl_doubles: FL_KIND_DOUBLES,                                                                           \
         struct fl_strings: FL_KIND_STRINGS,                                                                           \
         int: FL_KIND_CHOICE,                                                                                          \
         struct fl_device: FL_KIND_DEVICE),                                                                            \
     .offset = offsetof(type, member),                                                                                 \
     __VA_ARGS__}

/* --- an instance --- */

struct fl_block;
struct fl_service; /* the runtime's side */

struct fl_block {
    const struct fl_block_type *type;
    const char *name;       /* in the task */
    const void *parameters; /* the structure that the type's parameters describe */
    void *state;            /* state_size bytes, zero at start */

    /* Ports in the order of the tables of the type, then those that `configure` added. */
    const struct fl_port *in_ports, *out_ports;
    uint32_t in_count, out_count;
    const void *const *in; /* in[i]: the present elements of input i */
    void *const *out;

    int64_t period_ns;  /* of this block: the period of the task times `every` */
    int64_t release_ns; /* when this step was due, CLOCK_MONOTONIC; the same for all blocks in a step */
    uint64_t step;      /* steps of this block before this one */

    /* Time from the release of this block's previous step to that of this one, over which a step integrates. It is
     * exactly period_ns in the first step, and as long as no step was skipped or triggered off time. It is never
     * negative, and at most FL_LONGEST_INTERVAL periods, so that a task that was stopped for long continues without a
     * jump.
     */
    int64_t interval_ns;

    struct fl_service *service;
};

enum { FL_LONGEST_INTERVAL = 10 }; /* periods */

/* The interval in seconds. */
static inline double fl_interval_s(const struct fl_block *block)
{
    return 1e-9 * (double)block->interval_ns;
}

/* The value of a scalar port. */
#define FL_IN(block, port, c_type)  (*(const c_type *)(block)->in[port])
#define FL_OUT(block, port, c_type) (*(c_type *)(block)->out[port])

/* Memory that lives as long as the block, zeroed and aligned for any type; NULL after fl_fail(). Not in a step. */
void *fl_allocate(struct fl_block *block, size_t bytes);

/* Give the reason of a failure, as printf does; returns FL_FAILED. Also in a step: it only stores. */
int fl_fail(struct fl_block *block, const char *format, ...) __attribute__((format(printf, 2, 3)));

/* End the task in good order, with a reason: outputs go to their reset state, and the task is not started again. For
 * `return fl_end(...)` in a step; it only stores, too. */
int fl_end(struct fl_block *block, const char *format, ...) __attribute__((format(printf, 2, 3)));

/* From `safe`: the outputs may not be in their reset state, for a reason that is a constant. Whoever ends the task says
 * it, and its status differs. The first one counts. */
void fl_not_safe(struct fl_block *block, const char *reason);

/* Whether an actuator may act in this step; otherwise it keeps its reset state. After the start of a service it has to
 * wait until a command was off, unless the task says `restart: resume`: no motor turns because a process began anew
 * while somebody still commands it to. `off`: this step's command is good, and is one to rest. From then on it is true.
 */
bool fl_may_act(struct fl_block *block, bool off);

/* Write a line to the journal; not in a step. */
void fl_log(struct fl_block *block, const char *format, ...) __attribute__((format(printf, 2, 3)));

/* The same as a warning: something does not work. */
void fl_warn(struct fl_block *block, const char *format, ...) __attribute__((format(printf, 2, 3)));

/* Add a port from `configure`. The strings must live as long as the block: constants, or fl_allocate()'s. */
int fl_add_input(struct fl_block *block, struct fl_port port);
int fl_add_output(struct fl_block *block, struct fl_port port);

/* Whether the task file wires an input, which one with FL_OPTIONAL need not be. From `start` on. */
bool fl_wired(const struct fl_block *block, uint32_t input);

/* Whether the task file sets a parameter, by its place in the type's table; else it has its default. From `start` on.
 */
bool fl_given(const struct fl_block *block, uint32_t parameter);

/* CLOCK_MONOTONIC in nanoseconds. */
int64_t fl_now_ns(void);

/* --- a type --- */

struct fl_block_type {
    uint32_t abi; /* FL_ABI */
    const char *name;
    const char *summary;
    const char *source; /* where its behaviour is described: a manual, a standard, a section of a paper */
    const struct fl_port *inputs, *outputs;
    uint32_t input_count, output_count;
    const struct fl_parameter *parameters;
    uint32_t parameter_count;
    size_t parameters_size, state_size;
    int (*configure)(struct fl_block *block);
    int (*start)(struct fl_block *block);
    int (*initialize)(struct fl_block *block);
    int (*step)(struct fl_block *block);
    /* Wait until there is new input, or CLOCK_MONOTONIC is `until_ns`. Returns when the input came, or 0 on time-out.
     * The step uses exactly that input, and nothing newer. */
    int64_t (*await)(struct fl_block *block, int64_t until_ns);
    void (*safe)(struct fl_block *block);
    void (*terminate)(struct fl_block *block);
};

#define FL_TABLE(name, array) .name##s = (array), .name##_count = sizeof(array) / sizeof((array)[0])

/* Announce a type, once for each: FL_BLOCK(gain) = {.abi = FL_ABI, .name = "gain", ...};
 * The executive finds it in a program by itself, and in a shared object (a plug-in) through fl_blocks().
 */
#define FL_BLOCK(identifier)                                                                                           \
    static const struct fl_block_type fl_block_type_##identifier;                                                      \
    __attribute__((used,                                                                                               \
                   section("flotilla_blocks"))) static const struct fl_block_type *const fl_announced_##identifier =   \
        &fl_block_type_##identifier;                                                                                   \
    static const struct fl_block_type fl_block_type_##identifier

extern const struct fl_block_type *const __start_flotilla_blocks[] __attribute__((visibility("hidden"), weak));
extern const struct fl_block_type *const __stop_flotilla_blocks[] __attribute__((visibility("hidden"), weak));

/* The types that this program or plug-in announces. */
__attribute__((weak, visibility("default"))) const struct fl_block_type *const *fl_blocks(size_t *count);
__attribute__((weak, visibility("default"))) const struct fl_block_type *const *fl_blocks(size_t *count)
{
    /* Both are ends of one array, which the linker makes. NOLINTNEXTLINE(clang-analyzer-security.PointerSub) */
    *count = (size_t)(__stop_flotilla_blocks - __start_flotilla_blocks);
    return __start_flotilla_blocks;
}

#endif
