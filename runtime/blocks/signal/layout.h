/* Signals of mixed types as bytes: what pack, unpack and recorder have in common. */
#ifndef FLOTILLA_SIGNAL_LAYOUT_H
#define FLOTILLA_SIGNAL_LAYOUT_H

#include <flotilla/block.h>

#define LAYOUT_MEMBERS                                                                                                 \
    struct fl_texts types;                                                                                             \
    struct fl_reals widths;                                                                                            \
    struct fl_texts names

#define LAYOUT_PARAMETERS(type)                                                                                        \
    FL_PARAMETER(type, types, .summary = "of each signal: boolean, int8 to uint64, single, double"),                   \
        FL_PARAMETER(type, widths, .fallback = "", .min = 1, .max = 65536,                                             \
                     .summary = "elements of each signal; without the list all have one"),                             \
        FL_PARAMETER(type, names, .fallback = "", .summary = "of the ports, one for each signal")

struct layout_field {
    const char *name;
    enum fl_type type;
    uint32_t width;
    size_t offset; /* of its first byte */
};

struct layout {
    uint32_t count;
    struct layout_field *fields;
    size_t bytes; /* of all */
};

/* The parameters, as members of any block. */
struct layout_parameters {
    struct fl_texts types;
    struct fl_reals widths;
    struct fl_texts names;
};

#define LAYOUT(parameters) ((struct layout_parameters){(parameters)->types, (parameters)->widths, (parameters)->names})

/* Lay out what the parameters list, each signal at the next multiple of `alignment`, the first at `start`, itself such
 * a multiple. Signals without a name are called `stem` and their number. */
int layout_make(struct fl_block *block, struct layout_parameters parameters, const char *stem, size_t start,
                size_t alignment, struct layout *layout);

/* A letter, then letters, digits, _ or -. */
bool layout_is_name(const char *text);

/* Add a port for each, by fl_add_input or fl_add_output. */
int layout_add_ports(struct fl_block *block, const struct layout *layout,
                     int (*add)(struct fl_block *block, struct fl_port port), const char *summary);

/* Elements of a signal, tight, to bytes and back. Booleans become 0 or 1. */
void layout_put(enum fl_type type, uint32_t width, const void *signal, bool big_endian, uint8_t *bytes);
void layout_get(enum fl_type type, uint32_t width, const uint8_t *bytes, bool big_endian, void *signal);

#endif
