#define _GNU_SOURCE
#include "service.h"

#include <errno.h>
#include <flotilla/driver.h>
#include <poll.h>
#include <pthread.h>
#include <string.h>
#include <sys/eventfd.h>
#include <time.h>
#include <unistd.h>

#define SECOND_NS INT64_C(1000000000)

struct fl_driver {
    pthread_t thread;
    int stop_fd;
    void (*run)(struct fl_driver *driver, void *context);
    void *context;
};

static void *enter(void *argument)
{
    struct fl_driver *driver = argument;
    driver->run(driver, driver->context);
    return NULL;
}

static struct fl_driver *start(struct fl_block *block, struct fl_service *service,
                               void (*run)(struct fl_driver *driver, void *context), void *context)
{
    struct fl_driver *driver = fl_allocate(block, sizeof *driver);
    if (!driver)
        return NULL;
    driver->run = run;
    driver->context = context;
    driver->stop_fd = eventfd(0, EFD_CLOEXEC);
    if (driver->stop_fd < 0) {
        fl_fail(block, "eventfd: %s", strerror(errno));
        return NULL;
    }
    int error = fl_service_thread(service, &driver->thread, block->name, enter, driver);
    if (error) {
        close(driver->stop_fd);
        fl_fail(block, "cannot start the driver's thread: %s", strerror(error));
        return NULL;
    }
    return driver;
}

struct fl_driver *fl_driver_start(struct fl_block *block, void (*run)(struct fl_driver *driver, void *context),
                                  void *context)
{
    return start(block, block->service, run, context);
}

struct fl_driver *fl_driver_start_ordinary(struct fl_block *block, void (*run)(struct fl_driver *driver, void *context),
                                           void *context)
{
    struct fl_service ordinary = {0};
    return start(block, &ordinary, run, context);
}

void fl_driver_stop(struct fl_driver *driver)
{
    if (!driver)
        return;
    eventfd_write(driver->stop_fd, 1);
    pthread_join(driver->thread, NULL);
    close(driver->stop_fd);
}

int fl_driver_wait(const struct fl_driver *driver, int fd, bool writable, int timeout_ms)
{
    struct pollfd waiting[] = {{.fd = driver->stop_fd, .events = POLLIN},
                               {.fd = fd, .events = writable ? POLLOUT : POLLIN}};
    int ready = poll(waiting, 2, timeout_ms);
    if (ready < 0)
        return errno == EINTR ? 0 : -2;
    if (waiting[0].revents)
        return -1;
    /* Bytes that arrived before the hang-up are still read. */
    if (waiting[1].revents & (POLLIN | POLLOUT))
        return 1;
    return waiting[1].revents ? -2 : 0;
}

bool fl_await_readable(int fd, int64_t until_ns)
{
    struct pollfd waiting = {.fd = fd, .events = POLLIN};
    for (int64_t left_ns; (left_ns = until_ns - fl_now_ns()) > 0;) {
        const struct timespec timeout = {(time_t)(left_ns / SECOND_NS), (long)(left_ns % SECOND_NS)};
        if (ppoll(&waiting, 1, &timeout, NULL) > 0)
            return true;
    }
    return false;
}
