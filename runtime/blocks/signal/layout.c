#include "layout.h"

#include "ports.h"

#include <ctype.h>
#include <math.h>
#include <string.h>

bool layout_is_name(const char *text)
{
    if (!isalpha((unsigned char)*text))
        return false;
    while (isalnum((unsigned char)*text) || *text == '_' || *text == '-')
        text++;
    return !*text;
}

static int make_field(struct fl_block *block, const struct layout_parameters *parameters, const char *stem, uint32_t i,
                      struct layout_field *field)
{
    int type = fl_type_named(parameters->types.value[i]);
    double width = parameters->widths.count ? parameters->widths.value[i] : 1;
    if (type < 0)
        return fl_fail(block, "types: there is no type %s", parameters->types.value[i]);
    if (width != floor(width))
        return fl_fail(block, "widths: %g is not a whole number", width);
    field->name = parameters->names.count ? parameters->names.value[i] : port_numbered(block, stem, i);
    if (!field->name)
        return FL_FAILED;
    if (!layout_is_name(field->name))
        return fl_fail(block, "names: \"%s\" is not a letter, then letters, digits, _ or -", field->name);
    field->type = (enum fl_type)type;
    field->width = (uint32_t)width;
    return FL_OK;
}

int layout_make(struct fl_block *block, struct layout_parameters parameters, const char *stem, size_t start,
                size_t alignment, struct layout *layout)
{
    size_t count = parameters.types.count;
    if (!count)
        return fl_fail(block, "types is an empty list");
    if (parameters.widths.count && parameters.widths.count != count)
        return fl_fail(block, "%zu widths for %zu types", parameters.widths.count, count);
    if (parameters.names.count && parameters.names.count != count)
        return fl_fail(block, "%zu names for %zu types", parameters.names.count, count);
    *layout = (struct layout){.count = (uint32_t)count, .bytes = start};
    layout->fields = fl_allocate(block, count * sizeof *layout->fields);
    if (!layout->fields)
        return FL_FAILED;
    for (uint32_t i = 0; i < count; i++) {
        struct layout_field *field = &layout->fields[i];
        if (make_field(block, &parameters, stem, i, field) != FL_OK)
            return FL_FAILED;
        field->offset = (layout->bytes + alignment - 1) / alignment * alignment;
        layout->bytes = field->offset + fl_type_size(field->type) * field->width;
    }
    return FL_OK;
}

static bool has_port(const struct fl_port *ports, uint32_t count, const char *name)
{
    for (uint32_t i = 0; i < count; i++)
        if (strcmp(ports[i].name, name) == 0)
            return true;
    return false;
}

int layout_add_ports(struct fl_block *block, const struct layout *layout,
                     int (*add)(struct fl_block *block, struct fl_port port), const char *summary)
{
    for (uint32_t i = 0; i < layout->count; i++) {
        const struct layout_field *field = &layout->fields[i];
        const struct fl_port port = {
            .name = field->name, .type = field->type, .width = field->width, .summary = summary};
        if (has_port(block->in_ports, block->in_count, field->name) ||
            has_port(block->out_ports, block->out_count, field->name))
            return fl_fail(block, "names: there is a port %s already", field->name);
        if (add(block, port) != FL_OK)
            return FL_FAILED;
    }
    return FL_OK;
}

static bool is_big_endian(void)
{
    const uint16_t one = 1;
    uint8_t first;
    memcpy(&first, &one, 1);
    return first == 0;
}

static void copy(uint8_t *to, const uint8_t *from, size_t size, uint32_t width, bool swapped)
{
    if (!swapped) {
        memcpy(to, from, size * width);
        return;
    }
    for (uint32_t element = 0; element < width; element++, to += size, from += size)
        for (size_t i = 0; i < size; i++)
            to[i] = from[size - 1 - i];
}

static void make_boolean(uint8_t *elements, uint32_t width)
{
    for (uint32_t i = 0; i < width; i++)
        elements[i] = elements[i] != 0;
}

void layout_put(enum fl_type type, uint32_t width, const void *signal, bool big_endian, uint8_t *bytes)
{
    copy(bytes, signal, fl_type_size(type), width, big_endian != is_big_endian());
    if (type == FL_BOOLEAN)
        make_boolean(bytes, width);
}

void layout_get(enum fl_type type, uint32_t width, const uint8_t *bytes, bool big_endian, void *signal)
{
    copy(signal, bytes, fl_type_size(type), width, big_endian != is_big_endian());
    if (type == FL_BOOLEAN)
        make_boolean(signal, width);
}
