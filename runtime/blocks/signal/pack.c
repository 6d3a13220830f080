/** pack
 *
 * Packs signals of several types into bytes, as UDP or CAN carries them.
 *
 * Equations:
 *   begin(0) = 0,  begin(i) = begin(i − 1) + bytes of signal i − 1, rounded up to a multiple of `alignment`
 *   width of out = end of the last signal; bytes of gaps are 0
 *
 * Failure: Cannot fail in a step. More than 65507 bytes are refused when the task is loaded.
 */
#include "layout.h"

#include <string.h>

static const char source[] =
    "xPC Target I/O User's Guide, User Datagram Protocol: blocks Pack and Unpack; MathWorks, Byte Pack, Byte Unpack";

enum { LARGEST = 65507 }; /* of a UDP datagram over IPv4 */

#define FORMAT_PARAMETERS(type)                                                                                        \
    FL_PARAMETER(type, byte_order, .default_value = "little", .choices = "little|big",                                 \
                 .summary = "little: as an x86 sends; big: the network's"),                                            \
        FL_PARAMETER(type, alignment, .default_value = "1", .choices = "1|2|4|8", .unit = "byte",                      \
                     .summary = "each signal begins at a multiple of it; 1: no gaps")

struct pack {
    LAYOUT_MEMBERS;
    int byte_order, alignment; /* the alignment is 1 << alignment */
};

struct pack_state {
    struct layout layout;
};

static const struct fl_parameter pack_parameters[] = {
    LAYOUT_PARAMETERS(struct pack),
    FORMAT_PARAMETERS(struct pack),
};

static int make_pack(struct fl_block *block, struct layout *layout)
{
    const struct pack *pack = block->parameters;
    if (layout_make(block, LAYOUT(pack), "in", 0, (size_t)1 << pack->alignment, layout) != FL_OK)
        return FL_FAILED;
    return layout->bytes <= LARGEST ? FL_OK : fl_fail(block, "%zu bytes are more than %d", layout->bytes, LARGEST);
}

static int configure_pack(struct fl_block *block)
{
    struct layout layout;
    if (make_pack(block, &layout) != FL_OK)
        return FL_FAILED;
    struct fl_port out = {.name = "out", .type = FL_UINT8, .width = (uint32_t)layout.bytes, .summary = "the bytes"};
    if (fl_add_output(block, out) != FL_OK)
        return FL_FAILED;
    return layout_add_ports(block, &layout, fl_add_input, "is packed");
}

static int start_pack(struct fl_block *block)
{
    struct pack_state *state = block->state;
    return make_pack(block, &state->layout);
}

static int step_pack(struct fl_block *block)
{
    const struct pack *pack = block->parameters;
    const struct pack_state *state = block->state;
    uint8_t *out = block->out[0];
    for (uint32_t i = 0; i < state->layout.count; i++) {
        const struct layout_field *field = &state->layout.fields[i];
        layout_put(field->type, field->width, block->in[i], pack->byte_order, out + field->offset);
    }
    return FL_OK;
}

FL_BLOCK(pack) = {
    .abi = FL_ABI,
    .name = "pack",
    .summary = "signals to bytes: an input in0, in1, ... (or named) for each of types, an output `out`; gaps are zero",
    .source = source,
    FL_TABLE(parameter, pack_parameters),
    .parameters_size = sizeof(struct pack),
    .state_size = sizeof(struct pack_state),
    .configure = configure_pack,
    .start = start_pack,
    .step = step_pack,
};

/** unpack
 *
 * Unpacks bytes into signals of several types; they lie as `pack` lays them.
 *
 * Equations:
 *   begin(0) = 0,  begin(i) = begin(i − 1) + bytes of signal i − 1, rounded up to a multiple of `alignment`
 *
 * Failure: With `check_length`, an input of another length gives flag 0 and the values stay; without it the flag is
 * always 1. More than 65507 bytes, or a `size` below what the signals need, are refused when the task is loaded.
 */
struct unpack {
    LAYOUT_MEMBERS;
    int byte_order, alignment;
    int64_t size;
    bool check_length;
};

enum { BYTES, LENGTH };
enum { FLAG, VALUES };

struct unpack_state {
    struct layout layout;
};

static const struct fl_parameter unpack_parameters[] = {
    LAYOUT_PARAMETERS(struct unpack),
    FORMAT_PARAMETERS(struct unpack),
    FL_PARAMETER(struct unpack, size, .default_value = "0", .max = LARGEST, .unit = "byte",
                 .summary = "width of `in` where that is more than the signals need; 0: as they need"),
    FL_PARAMETER(struct unpack, check_length, .default_value = "false",
                 .summary = "have an input `length`: bytes that are good in `in`, which must be as the signals need"),
};

static const struct fl_port unpack_outputs[] = {
    {.name = "flag",
     .type = FL_BOOLEAN,
     .width = 1,
     .summary = "1: the values are those of `in`; 0: its length is wrong, they are as before"},
};

static int make_unpack(struct fl_block *block, struct layout *layout)
{
    const struct unpack *unpack = block->parameters;
    if (layout_make(block, LAYOUT(unpack), "out", 0, (size_t)1 << unpack->alignment, layout) != FL_OK)
        return FL_FAILED;
    if (layout->bytes > LARGEST)
        return fl_fail(block, "%zu bytes are more than %d", layout->bytes, LARGEST);
    if (unpack->size && (size_t)unpack->size < layout->bytes)
        return fl_fail(block, "size: the signals need %zu bytes", layout->bytes);
    return FL_OK;
}

static int configure_unpack(struct fl_block *block)
{
    const struct unpack *unpack = block->parameters;
    struct layout layout;
    if (make_unpack(block, &layout) != FL_OK)
        return FL_FAILED;
    uint32_t size = (uint32_t)(unpack->size ? (size_t)unpack->size : layout.bytes);
    struct fl_port in = {.name = "in", .type = FL_UINT8, .width = size, .summary = "bytes"};
    struct fl_port length = {
        .name = "length", .type = FL_UINT32, .width = 1, .unit = "byte", .summary = "how many of `in` are good"};
    if (fl_add_input(block, in) != FL_OK || (unpack->check_length && fl_add_input(block, length) != FL_OK))
        return FL_FAILED;
    return layout_add_ports(block, &layout, fl_add_output, "is unpacked");
}

static int start_unpack(struct fl_block *block)
{
    struct unpack_state *state = block->state;
    return make_unpack(block, &state->layout);
}

static int step_unpack(struct fl_block *block)
{
    const struct unpack *unpack = block->parameters;
    const struct unpack_state *state = block->state;
    const uint8_t *in = block->in[BYTES];
    bool good = !unpack->check_length || FL_IN(block, LENGTH, uint32_t) == state->layout.bytes;
    FL_OUT(block, FLAG, bool) = good;
    for (uint32_t i = 0; good && i < state->layout.count; i++) {
        const struct layout_field *field = &state->layout.fields[i];
        layout_get(field->type, field->width, in + field->offset, unpack->byte_order, block->out[VALUES + i]);
    }
    return FL_OK;
}

FL_BLOCK(unpack) = {
    .abi = FL_ABI,
    .name = "unpack",
    .summary = "bytes to signals: inputs `in` and `length`, an output out0, out1, ... (or named) for each of types",
    .source = source,
    FL_TABLE(output, unpack_outputs),
    FL_TABLE(parameter, unpack_parameters),
    .parameters_size = sizeof(struct unpack),
    .state_size = sizeof(struct unpack_state),
    .configure = configure_unpack,
    .start = start_unpack,
    .step = step_unpack,
};
