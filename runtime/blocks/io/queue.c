#define _GNU_SOURCE
#include "queue.h"

#include <errno.h>
#include <fcntl.h>
#include <grp.h>
#include <inttypes.h>
#include <limits.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

/* Locks on bytes of a queue record who uses it; the kernel drops them with the process, however it ends. There is one
 * for each end, and one that is held while a queue is opened or closed, so that this happens one at a time. A mqd_t of
 * Linux is a file descriptor, and locks of open file descriptions (fcntl(2)) work on it. */
enum { LOCK_ENDS = 0, LOCK_CHANGE = 2 };

static bool lock(mqd_t descriptor, off_t from, off_t count, short kind)
{
    struct flock range = {.l_type = kind, .l_whence = SEEK_SET, .l_start = from, .l_len = count};
    return fcntl(descriptor, F_OFD_SETLK, &range) == 0;
}

/* By another process or block. */
static bool is_held(int error)
{
    return error == EAGAIN || error == EACCES;
}

/* Whoever may open the queue may hold the lock: not for ever. */
static bool lock_changes(mqd_t descriptor)
{
    enum { TRIES = 2000, PAUSE_NS = 1000000 };
    bool locked = false;
    for (int i = 0; i < TRIES && !locked; i++) {
        locked = lock(descriptor, LOCK_CHANGE, 1, F_WRLCK);
        if (!locked && !is_held(errno))
            break;
        if (!locked) {
            nanosleep(&(struct timespec){.tv_nsec = PAUSE_NS}, NULL);
            errno = EAGAIN;
        }
    }
    return locked;
}

/* Whether only the holder of this descriptor uses the queue; then nobody else can begin to. */
static bool is_ours_alone(mqd_t descriptor)
{
    return lock(descriptor, LOCK_ENDS, 2, F_WRLCK);
}

/* Whether the queue still has its name: the last user may have removed it before this one had its lock. */
static bool is_removed(mqd_t descriptor)
{
    struct stat status;
    return fstat(descriptor, &status) < 0 || status.st_nlink == 0;
}

int queue_check_name(struct fl_block *block, const char *name)
{
    size_t length = strlen(name);
    if (name[0] != '/' || length < 2 || length > NAME_MAX || strchr(name + 1, '/'))
        return fl_fail(block, "parameter name: %s is not a slash and a name without one, such as /heading", name);
    return FL_OK;
}

static int fail_to_open(struct fl_block *block, const struct queue *queue, int64_t depth)
{
    switch (errno) {
    case EINVAL:
        return fl_fail(
            block, "queue %s: %" PRId64 " messages of %zu bytes exceed the limits fs.mqueue.msg_max and msgsize_max",
            queue->name, depth, queue->message_bytes);
    case EMFILE:
        return fl_fail(block, "queue %s: queues of this user exceed the limit RLIMIT_MSGQUEUE (LimitMSGQUEUE=)",
                       queue->name);
    case EACCES:
        return fl_fail(block, "queue %s belongs to another user: see ls -l /dev/mqueue", queue->name);
    case ENOSYS:
        return fl_fail(block, "queue %s: the kernel has no message queues (CONFIG_POSIX_MQUEUE)", queue->name);
    default:
        return fl_fail(block, "queue %s: %s", queue->name, strerror(errno));
    }
}

enum opened { OPENED, FAILED, AGAIN };

/* With the change lock held: check the opened queue, and take the lock of this end. */
static enum opened settle(struct queue *queue, struct fl_block *block, enum queue_end end, int64_t depth)
{
    struct mq_attr found;
    if (mq_getattr(queue->descriptor, &found) < 0) {
        fl_fail(block, "queue %s: %s", queue->name, strerror(errno));
        return FAILED;
    }
    if (found.mq_msgsize != (long)queue->message_bytes || found.mq_maxmsg != depth) {
        if (is_ours_alone(queue->descriptor) && mq_unlink(queue->name) == 0)
            return AGAIN;
        fl_fail(block,
                "queue %s holds %ld messages of %ld bytes, and a running task uses it; here they are %" PRId64
                " of %zu: type, width and depth must agree at both ends",
                queue->name, found.mq_maxmsg, found.mq_msgsize, depth, queue->message_bytes);
        return FAILED;
    }
    if (!lock(queue->descriptor, LOCK_ENDS + (off_t)end, 1, F_WRLCK)) {
        if (is_held(errno))
            fl_fail(block, "another block already %s queue %s", end == QUEUE_SENDER ? "sends to" : "receives from",
                    queue->name);
        else
            fl_fail(block, "queue %s cannot be locked: %s", queue->name, strerror(errno));
        return FAILED;
    }
    return OPENED;
}

/* Tasks of a robot have users of their own, so their queues are of a group that all are in. Whose queue it is not may
 * not change it, and need not. */
static void share(mqd_t descriptor)
{
    const char *name = getenv("FLOTILLA_QUEUE_GROUP");
    const struct group *group = name ? getgrnam(name) : NULL;
    if (group)
        (void)!fchown(descriptor, (uid_t)-1, group->gr_gid);
}

/* Another task may have made the queue just now, and not yet have shared it. */
static mqd_t open_shared(const char *name, struct mq_attr *wanted)
{
    enum { TRIES = 50, PAUSE_NS = 1000000 };
    mqd_t descriptor = -1;
    for (int i = 0; i < TRIES; i++) {
        descriptor = mq_open(name, O_RDWR | O_CREAT | O_NONBLOCK | O_CLOEXEC, 0660, wanted);
        if (descriptor >= 0 || errno != EACCES)
            break;
        nanosleep(&(struct timespec){.tv_nsec = PAUSE_NS}, NULL);
        errno = EACCES;
    }
    return descriptor;
}

static enum opened open_once(struct queue *queue, struct fl_block *block, enum queue_end end, int64_t depth)
{
    struct mq_attr wanted = {.mq_maxmsg = (long)depth, .mq_msgsize = (long)queue->message_bytes};
    queue->descriptor = open_shared(queue->name, &wanted);
    if (queue->descriptor < 0) {
        fail_to_open(block, queue, depth);
        return FAILED;
    }
    share(queue->descriptor);
    enum opened opened = FAILED;
    if (!lock_changes(queue->descriptor))
        fl_fail(block, "queue %s cannot be locked: %s", queue->name,
                is_held(errno) ? "another process holds its lock: end the tasks that use it" : strerror(errno));
    else if (is_removed(queue->descriptor))
        opened = AGAIN;
    else
        opened = settle(queue, block, end, depth);
    if (opened == OPENED)
        lock(queue->descriptor, LOCK_CHANGE, 1, F_UNLCK);
    else
        mq_close(queue->descriptor);
    return opened;
}

int queue_open(struct queue *queue, struct fl_block *block, enum queue_end end, const char *name, enum fl_type type,
               int64_t width, int64_t depth)
{
    enum opened opened;
    *queue = (struct queue){.name = name, .data_bytes = fl_type_size(type) * (size_t)width};
    queue->message_bytes = sizeof(struct queue_message) + queue->data_bytes;
    queue->message = fl_allocate(block, queue->message_bytes);
    if (!queue->message)
        return FL_FAILED;
    do /* try again only if another process has just removed the queue */
        opened = open_once(queue, block, end, depth);
    while (opened == AGAIN);
    queue->open = opened == OPENED;
    return queue->open ? FL_OK : FL_FAILED;
}

bool queue_put(struct queue *queue)
{
    return mq_send(queue->descriptor, (const char *)queue->message, queue->message_bytes, 0) == 0;
}

bool queue_take(struct queue *queue)
{
    ssize_t got = mq_receive(queue->descriptor, (char *)queue->message, queue->message_bytes, NULL);
    if (got >= 0 && (size_t)got != queue->message_bytes)
        queue->message->type = FL_TYPES;
    return got >= 0;
}

void queue_close(struct queue *queue)
{
    if (!queue->open)
        return;
    /* Closing the descriptor releases the locks. A process that is just opening the queue holds the change lock, and
     * keeps the queue. */
    if (lock(queue->descriptor, LOCK_CHANGE, 1, F_WRLCK) && is_ours_alone(queue->descriptor) &&
        !is_removed(queue->descriptor))
        mq_unlink(queue->name);
    mq_close(queue->descriptor);
    queue->open = false;
}
