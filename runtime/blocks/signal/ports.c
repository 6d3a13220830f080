#include "ports.h"

#include <inttypes.h>
#include <stdio.h>
#include <string.h>

const char *port_numbered(struct fl_block *block, const char *stem, uint32_t number)
{
    enum { DIGITS = 10 };
    size_t bytes = strlen(stem) + DIGITS + 1;
    char *name = fl_allocate(block, bytes);
    if (name)
        snprintf(name, bytes, "%s%" PRIu32, stem, number);
    return name;
}
