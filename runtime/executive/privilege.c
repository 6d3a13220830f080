#define _GNU_SOURCE
#include "privilege.h"

#include "core/service.h"

#include <errno.h>
#include <inttypes.h>
#include <linux/capability.h>
#include <pthread.h>
#include <sched.h>
#include <stdbool.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

enum {
    THREAD_STACK_BYTES = 256 * 1024,
    TOUCHED_BYTES = 128 * 1024, /* before the first step */
};

/* Of locked memory: Cyclone DDS makes threads reserve 600 MB of addresses, which count. */
#define ENOUGH_BYTES (UINT64_C(1) << 30)

static bool is_capable(unsigned capability)
{
    struct __user_cap_header_struct header = {.version = _LINUX_CAPABILITY_VERSION_3};
    struct __user_cap_data_struct sets[_LINUX_CAPABILITY_U32S_3] = {0};
    return syscall(SYS_capget, &header, sets) == 0 && sets[0].effective >> capability & 1;
}

/* The bytes that may be locked, or ENOUGH_BYTES. */
static uint64_t lockable(void)
{
    struct rlimit limit;
    if (getrlimit(RLIMIT_MEMLOCK, &limit) < 0 || limit.rlim_cur >= ENOUGH_BYTES || is_capable(CAP_IPC_LOCK))
        return ENOUGH_BYTES;
    limit.rlim_cur = limit.rlim_max;
    setrlimit(RLIMIT_MEMLOCK, &limit);
    return limit.rlim_max < ENOUGH_BYTES ? limit.rlim_max : ENOUGH_BYTES;
}

void privilege_lock_memory(void)
{
    static const char consequence[] = "(CAP_IPC_LOCK or LimitMEMLOCK=): a page fault may delay a step";
    pthread_attr_t attributes;
    if (!pthread_attr_init(&attributes)) {
        pthread_attr_setstacksize(&attributes, THREAD_STACK_BYTES);
        pthread_setattr_default_np(&attributes);
        pthread_attr_destroy(&attributes);
    }
    /* Where future memory is locked, too, no thread starts beyond the limit. */
    const uint64_t bytes = lockable();
    if (mlockall(bytes < ENOUGH_BYTES ? MCL_CURRENT : MCL_CURRENT | MCL_FUTURE) < 0)
        fprintf(stderr, "%sflotilla: memory cannot be locked: %s %s\n", fl_priority(FL_WARNING), strerror(errno),
                consequence);
    else if (bytes < ENOUGH_BYTES)
        fprintf(stderr,
                "%sflotilla: this user may lock %" PRIu64 " kB of memory, so that later memory is not locked %s\n",
                fl_priority(FL_WARNING), bytes / 1024, consequence);
}

int privilege_priority(int priority, const char *consequence)
{
    struct sched_param before, wanted = {.sched_priority = priority};
    if (!priority)
        return 0;
    int policy = sched_getscheduler(0);
    if (sched_getparam(0, &before) < 0 || sched_setscheduler(0, SCHED_FIFO, &wanted) < 0) {
        fprintf(stderr, "%sflotilla: SCHED_FIFO %d is refused (%s; CAP_SYS_NICE or LimitRTPRIO=): %s\n",
                fl_priority(FL_WARNING), priority, strerror(errno), consequence);
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
