/* The I/O ports of the processor, which a test replaces: it has no board, and must not touch its computer's. */
#ifndef FLOTILLA_IO_PORTS_H
#define FLOTILLA_IO_PORTS_H

#include <stdbool.h>
#include <stdint.h>

struct port_space {
    /* Ask for `count` ports from `first` on, or give them up. 0 or an errno. For the calling thread, and those that it
     * starts afterwards: see ioperm(2). */
    int (*permit)(uint16_t first, uint16_t count, bool on);
    uint8_t (*in)(uint16_t port);
    void (*out)(uint16_t port, uint8_t value);
};

/* The processor's own unless a test says otherwise, before it starts a block. There is one port space in a computer, so
 * this may be global. */
extern const struct port_space *port_space;

#endif
