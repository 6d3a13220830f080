#define _GNU_SOURCE
#include "privilege.h"

#include <errno.h>
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>

enum {
    THREAD_STACK_BYTES = 256 * 1024,
    TOUCHED_BYTES = 128 * 1024, /* before the first step */
};

void privilege_lock_memory(void)
{
    pthread_attr_t attributes;
    if (!pthread_attr_init(&attributes)) {
        pthread_attr_setstacksize(&attributes, THREAD_STACK_BYTES);
        pthread_setattr_default_np(&attributes);
        pthread_attr_destroy(&attributes);
    }
    if (mlockall(MCL_CURRENT | MCL_FUTURE) < 0)
        fprintf(
            stderr,
            "flotilla: memory cannot be locked (%s; CAP_IPC_LOCK or LimitMEMLOCK=): a page fault may delay a step\n",
            strerror(errno));
}

int privilege_priority(int priority, const char *consequence)
{
    struct sched_param before, wanted = {.sched_priority = priority};
    if (!priority)
        return 0;
    int policy = sched_getscheduler(0);
    if (sched_getparam(0, &before) < 0 || sched_setscheduler(0, SCHED_FIFO, &wanted) < 0) {
        fprintf(stderr, "flotilla: SCHED_FIFO %d is refused (%s; CAP_SYS_NICE or LimitRTPRIO=): %s\n", priority,
                strerror(errno), consequence);
        return 0;
    }
    sched_setscheduler(0, policy, &before);
    return priority;
}

int privilege_processor(int cpu)
{
    cpu_set_t wanted;
    if (cpu >= CPU_SETSIZE)
        return EINVAL;
    CPU_ZERO(&wanted);
    CPU_SET((size_t)cpu, &wanted);
    return sched_setaffinity(0, sizeof wanted, &wanted) < 0 ? errno : 0;
}

void privilege_touch_stack(void)
{
    volatile unsigned char stack[TOUCHED_BYTES];
    for (size_t i = 0; i < sizeof stack; i += 1024)
        stack[i] = 0;
}
