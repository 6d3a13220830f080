/* Signals of mixed types as bytes, for pack, unpack and recorder. */
#ifndef FLOTILLA_SIGNAL_LAYOUT_H
#define FLOTILLA_SIGNAL_LAYOUT_H

#include <flotilla/block.h>

#define LAYOUT_MEMBERS                                                                                                 \
    struct fl_strings types;                                                                                           \
    struct fl_doubles widths;                                                                                          \
    struct fl_strings names

#define LAYOUT_PARAMETERS(type)                                                                                        \
    FL_PARAMETER(type, types, .summary = "of each signal: boolean, int8 to uint64, single, double"),                   \
        FL_PARAMETER(type, widths, .default_value = "", .min = 1, .max = 65536,                                        \
                     .summary = "elements of each signal; without the list all have one"),                             \
        FL_PARAMETER(type, names, .default_value = "", .summary = "of the ports, one for each signal")

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
    struct fl_strings types;
    struct fl_doubles widths;
    struct fl_strings names;
};

#define LAYOUT(parameters) ((struct layout_parameters){(parameters)->types, (parameters)->widths, (parameters)->names})

/* Lay out the signals that the parameters list, each at the next multiple of `alignment`. The first one is at `start`,
 * a multiple of it, too. Signals without a name are named by `stem` and their number. */
int layout_make(struct fl_block *block, struct layout_parameters parameters, const char *stem, size_t start,
                size_t alignment, struct layout *layout);

/* A letter, then letters, digits, _ or -. */
bool layout_is_name(const char *text);

/* Add a port for each, by fl_add_input or fl_add_output. */
int layout_add_ports(struct fl_block *block, const struct layout *layout,
                     int (*add)(struct fl_block *block, struct fl_port port), const char *summary);

/* Copy the elements of a signal, without gaps, to bytes and back. Booleans become 0 or 1. */
void layout_put(enum fl_type type, uint32_t width, const void *signal, bool big_endian, uint8_t *bytes);
void layout_get(enum fl_type type, uint32_t width, const uint8_t *bytes, bool big_endian, void *signal);

#endif
