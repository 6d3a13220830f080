/* With dc1394_bus.c a libdc1394 for robots without FireWire, such as guests. Its camera is plugged in while there is a
 * file of the name in the environment's DC1394_PLUG, and sees a white square in the upper right quarter. */
#define _GNU_SOURCE
#include "dc1394_bus.h"

#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

static void *film(void *plug)
{
    const struct timespec interval = {.tv_nsec = 500 * 1000 * 1000};
    for (;; nanosleep(&interval, NULL)) {
        bool plugged = access(plug, F_OK) == 0;
        if (bus.present && !plugged)
            bus_unplug();
        LOCKED(bus.present = plugged);
        if (plugged)
            bus_expose(0);
    }
    return NULL;
}

__attribute__((constructor)) static void begin(void)
{
    pthread_t thread;
    char *plug = getenv("DC1394_PLUG");
    for (int row = HEIGHT / 4 - 20; row < HEIGHT / 4 + 20; row++)
        memset(bus.image + row * STRIDE + WIDTH * 3 / 4 - 20, 255, 40);
    if (!plug || pthread_create(&thread, NULL, film, plug))
        abort();
}
