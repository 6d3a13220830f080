/* What stands for libdc1394 where no FireWire is: one camera, or none. That a real camera accepts the modes and the
 * order of the calls only hardware can show. */
#ifndef FLOTILLA_CAMERA_DC1394_BUS_H
#define FLOTILLA_CAMERA_DC1394_BUS_H

#include <dc1394/dc1394.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>

enum { WIDTH = 640, HEIGHT = 480, STRIDE = 700, BUS_BUFFERS = 3 };
#define GUID UINT64_C(0x00b09d0100a1b2c3)

extern struct bus {
    pthread_mutex_t lock;
    pthread_cond_t changed;
    bool present, transmits, corrupt;
    int looked, lost; /* times that it was looked for; calls in a wrong order */
    int fds[2];
    dc1394video_mode_t mode;
    dc1394framerate_t rate;
    int32_t roi[2];
    float shutter;
    dc1394camera_t camera;
    dc1394camera_id_t ids[2];
    dc1394camera_list_t list;
    struct {
        dc1394video_frame_t frame;
        uint8_t image[STRIDE * HEIGHT];
        bool full; /* until it is given back */
    } buffers[BUS_BUFFERS];
    unsigned filled, taken;   /* buffers so far, in turn */
    void (*given_back)(void); /* called before one is; may be NULL */
    uint8_t image[STRIDE * HEIGHT];
} bus;

#define LOCKED(...)                                                                                                    \
    do {                                                                                                               \
        pthread_mutex_lock(&bus.lock);                                                                                 \
        __VA_ARGS__;                                                                                                   \
        pthread_cond_broadcast(&bus.changed);                                                                          \
        pthread_mutex_unlock(&bus.lock);                                                                               \
    } while (0)

/* Hand over `bus.image`, which is `age_ms` old, unless nobody takes images or all buffers are full. */
void bus_expose(int64_t age_ms);

/* The same with the lock held. */
void bus_fill(int64_t age_ms);

void bus_unplug(void);

#endif
