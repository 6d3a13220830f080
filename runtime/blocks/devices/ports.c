#include "ports.h"

#include <errno.h>

#if defined(__i386__) || defined(__x86_64__)
#include <sys/io.h>

static int permit(uint16_t first, uint16_t count, bool on)
{
    return ioperm(first, count, on) < 0 ? errno : 0;
}

static uint8_t in(uint16_t port)
{
    return inb(port);
}

static void out(uint16_t port, uint8_t value)
{
    outb(value, port);
}

#else /* other processors have no port space; nothing is read or written where none was permitted */

static int permit(uint16_t first, uint16_t count, bool on)
{
    (void)first, (void)count, (void)on;
    return ENOSYS;
}

static uint8_t in(uint16_t port)
{
    (void)port;
    return 0;
}

static void out(uint16_t port, uint8_t value)
{
    (void)port, (void)value;
}

#endif

static const struct port_space processor = {permit, in, out};
const struct port_space *port_space = &processor;
