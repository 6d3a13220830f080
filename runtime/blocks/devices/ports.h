/* The I/O ports of the processor, which a test replaces, because it must not touch those of its computer. */
#ifndef FLOTILLA_DEVICES_PORTS_H
#define FLOTILLA_DEVICES_PORTS_H

#include <stdbool.h>
#include <stdint.h>

struct port_space {
    /* Ask for `count` ports from `first` on, or give them up. 0 or an errno. For the calling thread, and those that it
     * starts afterwards: see ioperm(2). */
    int (*permit)(uint16_t first, uint16_t count, bool on);
    uint8_t (*in)(uint16_t port);
    void (*out)(uint16_t port, uint8_t value);
};

/* The ports of the processor, unless a test replaces them before it starts a block. A computer has one port space, so
 * this may be global. */
extern const struct port_space *port_space;

#endif
