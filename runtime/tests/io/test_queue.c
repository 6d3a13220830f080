#define _GNU_SOURCE
#include "testbed.h"

#include "blocks/io/queue.h"
#include "core/service.h"

#include <errno.h>
#include <fcntl.h>
#include <grp.h>
#include <linux/capability.h>
#include <math.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

static char name[32];       /* this test's own queue */
static int lock_error;      /* with which the kernel refuses a lock; 0: it does not */
static off_t refused_range; /* that begins here */

/* Of the C library. */
int fcntl(int fd, int command, ...)
{
    va_list arguments;
    va_start(arguments, command);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    if (lock_error && command == F_OFD_SETLK && ((const struct flock *)argument)->l_start == refused_range) {
        errno = lock_error;
        return -1;
    }
#ifdef SYS_fcntl64
    return (int)syscall(SYS_fcntl64, fd, command, argument);
#else
    return (int)syscall(SYS_fcntl, fd, command, argument);
#endif
}

static mqd_t open_queue(int flags, long messages, long bytes)
{
    struct mq_attr attributes = {.mq_maxmsg = messages, .mq_msgsize = bytes};
    return mq_open(name, flags | O_NONBLOCK | O_CLOEXEC, 0600, &attributes);
}

static void refuses_to_start(struct fl_block *block, const char *reason)
{
    assert_int_equal(block->type->start(block), FL_FAILED);
    if (!strstr(block->service->failure, reason))
        fail_msg("%s", block->service->failure);
    testbed_end(block);
}

static void assert_gone(void)
{
    assert_int_equal(open_queue(O_RDWR, 0, 0), -1);
    assert_int_equal(errno, ENOENT);
}

static void step(struct fl_block *block)
{
    assert_int_equal(testbed_step(block), FL_OK);
}

static void send_values(struct fl_block *send, double from, double to)
{
    for (double value = from; value <= to; value++) {
        SET(send, "data", double, value);
        step(send);
    }
}

static void carries_every_type(void **state)
{
    (void)state;
    for (int type = 0; type < FL_TYPES; type++) {
        const char *type_name = fl_type_name((enum fl_type)type);
        struct fl_block *send = testbed_block("queue-send", "name", name, "type", type_name, "width", "3", NULL);
        struct fl_block *receive =
            testbed_block("queue-receive", "name", name, "type", type_name, "width", "3", "timeout", "60", NULL);
        size_t bytes = 3 * fl_type_size((enum fl_type)type);
        assert_int_equal(send->in_ports[0].type, type);
        testbed_begin(receive);
        testbed_begin(send);
        step(receive);
        assert_false(GET(receive, "flag", bool));
        memset(testbed_input(send, "data"), 1, bytes);
        step(send);
        step(receive);
        assert_true(GET(receive, "flag", bool));
        assert_int_equal(GET(receive, "sequence", uint32_t), 1);
        assert_memory_equal(testbed_output(receive, "data"), testbed_input(send, "data"), bytes);
        testbed_end(send);
        testbed_end(receive);
    }
    assert_gone();
}

static void takes_newest_or_in_order(void **state)
{
    (void)state;
    static const struct {
        const char *take;
        double first, second;
    } cases[] = {{"newest", 3, 3}, {"in-order", 1, 2}};
    for (int i = 0; i < 2; i++) {
        struct fl_block *send = testbed_block("queue-send", "name", name, NULL);
        struct fl_block *receive = testbed_block("queue-receive", "name", name, "take", cases[i].take, NULL);
        testbed_begin(send);
        testbed_begin(receive);
        send_values(send, 1, 3);
        step(receive);
        assert_near(GET(receive, "data", double), cases[i].first, 0);
        step(receive);
        assert_near(GET(receive, "data", double), cases[i].second, 0);
        step(receive);
        assert_near(GET(receive, "data", double), 3, 0);
        assert_int_equal(GET(receive, "sequence", uint32_t), 3);
        assert_int_equal(GET(receive, "dropped", uint32_t), 0);
        testbed_end(receive);
        testbed_end(send);
    }
}

/* Six messages into room for four: which are left, and what both sides count. */
static void drops(const char *full, double first, uint32_t sent, uint32_t dropped, uint32_t missed)
{
    struct fl_block *send = testbed_block("queue-send", "name", name, "depth", "4", "full", full, NULL);
    struct fl_block *receive = testbed_block("queue-receive", "name", name, "depth", "4", "take", "in-order", NULL);
    testbed_begin(send);
    testbed_begin(receive);
    send_values(send, 100, 100);
    step(receive);
    send_values(send, 1, 6);
    assert_int_equal(GET(send, "sent", uint32_t), sent);
    assert_int_equal(GET(send, "dropped", uint32_t), dropped);
    for (double value = first; value < first + 4; value++) {
        step(receive);
        assert_near(GET(receive, "data", double), value, 0);
    }
    send_values(send, 7, 7);
    step(receive);
    assert_near(GET(receive, "data", double), 7, 0);
    assert_int_equal(GET(receive, "sequence", uint32_t), 6);
    assert_int_equal(GET(receive, "dropped", uint32_t), missed);
    testbed_end(send);
    /* A sender that starts again counts from one; that is no loss. */
    send = testbed_block("queue-send", "name", name, "depth", "4", NULL);
    testbed_begin(send);
    send_values(send, 8, 8);
    step(receive);
    assert_near(GET(receive, "data", double), 8, 0);
    assert_int_equal(GET(receive, "dropped", uint32_t), missed);
    testbed_end(receive);
    testbed_end(send);
    assert_gone();
}

static void drops_as_told(void **state)
{
    (void)state;
    drops("drop-oldest", 3, 7, 2, 2);
    drops("drop-newest", 1, 5, 2, 2);
}

static void ages_from_sending(void **state)
{
    (void)state;
    struct fl_block *send = testbed_block("queue-send", "name", name, NULL);
    struct fl_block *receive = testbed_block("queue-receive", "name", name, "timeout", "60", NULL);
    testbed_begin(send);
    testbed_begin(receive);
    int64_t before = fl_now_ns();
    send_values(send, 1, 1);
    int64_t after = fl_now_ns();
    receive->release_ns = after + 30000000;
    step(receive);
    int64_t sent = receive->release_ns - llround(GET(receive, "age", double) * 1e9);
    assert_in_range(sent, before, after);
    assert_true(GET(receive, "flag", bool));
    receive->release_ns = sent + 60000000000 - receive->period_ns;
    step(receive);
    assert_true(GET(receive, "flag", bool));
    receive->release_ns = sent + 60000000001 - receive->period_ns;
    step(receive);
    assert_false(GET(receive, "flag", bool));
    assert_near(GET(receive, "data", double), 1, 0);
    testbed_end(receive);
    testbed_end(send);
}

static void drops_what_waited_before(void **state)
{
    (void)state;
    struct fl_block *send = testbed_block("queue-send", "name", name, NULL);
    struct fl_block *receive = testbed_block("queue-receive", "name", name, NULL);
    testbed_begin(send);
    send_values(send, 1, 3);
    testbed_begin(receive);
    step(receive);
    assert_int_equal(GET(receive, "sequence", uint32_t), 0);
    assert_false(GET(receive, "flag", bool));
    send_values(send, 4, 4);
    step(receive);
    assert_near(GET(receive, "data", double), 4, 0);
    assert_int_equal(GET(receive, "dropped", uint32_t), 0);
    testbed_end(receive);
    testbed_end(send);
}

static void refuses_foreign_messages(void **state)
{
    (void)state;
    struct fl_block *receive = testbed_block("queue-receive", "name", name, NULL);
    struct queue_message *message = calloc(1, sizeof *message + 8);
    testbed_begin(receive);
    mqd_t queue = open_queue(O_RDWR, 0, 0);
    assert_true(queue >= 0);
    *message = (struct queue_message){.sent_ns = fl_now_ns(), .sequence = 1, .type = FL_DOUBLE, .width = 1};
    assert_int_equal(mq_send(queue, (char *)message, sizeof *message + 7, 0), 0); /* short */
    message->type = FL_INT64;
    assert_int_equal(mq_send(queue, (char *)message, sizeof *message + 8, 0), 0); /* same size, other type */
    message->type = FL_DOUBLE;
    message->width = 2;
    assert_int_equal(mq_send(queue, (char *)message, sizeof *message + 8, 0), 0);
    step(receive);
    assert_int_equal(GET(receive, "refused", uint32_t), 3);
    assert_int_equal(GET(receive, "sequence", uint32_t), 0);
    assert_false(GET(receive, "flag", bool));
    message->width = 1;
    assert_int_equal(mq_send(queue, (char *)message, sizeof *message + 8, 0), 0);
    step(receive);
    assert_int_equal(GET(receive, "sequence", uint32_t), 1);
    mq_close(queue);
    free(message);
    testbed_end(receive);
}

/* A queue whose users are gone, as after kill -9. */
static void leave_stale(long messages, long bytes)
{
    mqd_t queue = open_queue(O_RDWR | O_CREAT | O_EXCL, messages, bytes);
    assert_true(queue >= 0);
    assert_int_equal(mq_send(queue, "stale", 5, 0), 0);
    mq_close(queue);
}

static void takes_over_a_stale_queue(void **state)
{
    (void)state;
    static const long shapes[][2] = {
        {10, sizeof(struct queue_message) + 8}, {10, 5}, {3, sizeof(struct queue_message) + 8}};
    for (size_t i = 0; i < 3; i++) {
        leave_stale(shapes[i][0], shapes[i][1]);
        struct fl_block *receive = testbed_block("queue-receive", "name", name, NULL);
        struct fl_block *send = testbed_block("queue-send", "name", name, NULL);
        testbed_begin(receive);
        testbed_begin(send);
        step(receive);
        assert_int_equal(GET(receive, "refused", uint32_t), 0);
        send_values(send, 1, 10);
        step(receive);
        assert_near(GET(receive, "data", double), 10, 0);
        assert_int_equal(GET(receive, "sequence", uint32_t), 10);
        testbed_end(receive);
        testbed_end(send);
        assert_gone();
    }
}

/* The kernel lets go of a killed task's locks. */
static void takes_over_from_the_killed(void **state)
{
    (void)state;
    struct fl_block *first = testbed_block("queue-send", "name", name, "width", "2", NULL);
    int status;
    pid_t child = fork();
    if (child == 0) {
        if (first->type->start(first) == FL_OK)
            raise(SIGKILL);
        _exit(1);
    }
    assert_int_equal(waitpid(child, &status, 0), child);
    assert_int_equal(WTERMSIG(status), SIGKILL);
    testbed_end(first);
    struct fl_block *send = testbed_block("queue-send", "name", name, NULL);
    testbed_begin(send);
    testbed_end(send);
    assert_gone();
}

static void refuses_a_queue_in_use(void **state)
{
    (void)state;
    struct fl_block *send = testbed_block("queue-send", "name", name, NULL);
    struct fl_block *receive = testbed_block("queue-receive", "name", name, NULL);
    testbed_begin(send);
    testbed_begin(receive);
    refuses_to_start(testbed_block("queue-send", "name", name, NULL),
                     "another block already sends to queue /flotilla-");
    refuses_to_start(testbed_block("queue-receive", "name", name, NULL), "another block already receives from queue");
    testbed_end(receive);
    refuses_to_start(testbed_block("queue-receive", "name", name, "width", "2", NULL),
                     "holds 10 messages of 24 bytes, and a running task uses it; here they are 10 of 32");
    refuses_to_start(testbed_block("queue-receive", "name", name, "depth", "9", NULL), "here they are 9 of 24");
    /* None of them broke it. */
    receive = testbed_block("queue-receive", "name", name, NULL);
    testbed_begin(receive);
    send_values(send, 1, 1);
    step(receive);
    assert_near(GET(receive, "data", double), 1, 0);
    testbed_end(send);
    mqd_t kept = open_queue(O_RDWR, 0, 0); /* the receiver still has it */
    assert_true(kept >= 0);
    mq_close(kept);
    testbed_end(receive);
    assert_gone();
}

static void *start(void *block)
{
    return (void *)(intptr_t)((struct fl_block *)block)->type->start(block);
}

/* How many descriptors of this process are open on `file`. */
static int descriptors(const struct stat *file)
{
    enum { DESCRIPTORS = 1024 };
    struct stat found;
    int count = 0;
    for (int fd = 0; fd < DESCRIPTORS; fd++)
        count += fstat(fd, &found) == 0 && found.st_dev == file->st_dev && found.st_ino == file->st_ino;
    return count;
}

/* Between opening a queue and locking it its last user removes it: the block must make another, or it would send into
 * one that no receiver finds. */
static void makes_anew_what_is_being_removed(void **state)
{
    (void)state;
    struct fl_block *send = testbed_block("queue-send", "name", name, NULL);
    struct flock change = {.l_type = F_WRLCK, .l_whence = SEEK_SET, .l_start = 2, .l_len = 1};
    struct stat file;
    pthread_t thread;
    void *result;
    mqd_t removed = open_queue(O_RDWR | O_CREAT | O_EXCL, 10, sizeof(struct queue_message) + 8);
    assert_int_equal(fstat(removed, &file), 0);
    assert_int_equal(fcntl(removed, F_OFD_SETLK, &change), 0);
    assert_int_equal(pthread_create(&thread, NULL, start, send), 0);
    while (descriptors(&file) < 2) /* the block has opened it, and cannot lock it yet */
        sched_yield();
    mq_unlink(name);
    mq_close(removed);
    pthread_join(thread, &result);
    assert_int_equal((intptr_t)result, FL_OK);
    mqd_t made = open_queue(O_RDWR, 0, 0);
    assert_true(made >= 0);
    mq_close(made);
    testbed_end(send);
    assert_gone();
}

/* With a group that this process is in, or root, which may give it any. Seen to fail without the variable. */
static void is_of_the_group_that_tasks_share(void **state)
{
    (void)state;
    gid_t groups[64], wanted = 1;
    struct stat file;
    int count = getgroups(64, groups);
    for (int i = 0; i < count && geteuid() != 0; i++)
        wanted = groups[i];
    struct group *group = getgrgid(wanted);
    assert_non_null(group);
    setenv("FLOTILLA_QUEUE_GROUP", group->gr_name, 1);
    struct fl_block *send = testbed_block("queue-send", "name", name, NULL);
    assert_int_equal(send->type->start(send), FL_OK);
    unsetenv("FLOTILLA_QUEUE_GROUP");
    mqd_t made = open_queue(O_RDWR, 0, 0);
    assert_true(made >= 0);
    assert_int_equal(fstat(made, &file), 0);
    assert_int_equal(file.st_gid, wanted);
    mq_close(made);
    testbed_end(send);
    assert_gone();
}

static void refuses(void **state)
{
    (void)state;
    static const char *const names[] = {"heading", "/", "", "/a/b"};
    for (size_t i = 0; i < sizeof names / sizeof names[0]; i++) {
        assert_non_null(strstr(testbed_refusal("queue-send", "name", names[i], NULL), "parameter name: "));
        assert_non_null(strstr(testbed_refusal("queue-receive", "name", names[i], NULL), "parameter name: "));
    }
    assert_non_null(
        strstr(testbed_refusal("queue-send", "name", name, "type", "float", NULL), "float is not one of boolean|"));
    assert_non_null(strstr(testbed_refusal("queue-send", "name", name, "width", "0", NULL), "0 is outside 1 to 1000"));
    assert_non_null(strstr(testbed_refusal("queue-send", NULL), "parameter name of queue-send is missing"));
}

/* In a child, which lowers a limit for itself: what start says then. */
static void refuses_beyond(bool (*lower)(void), const char *depth, const char *reason)
{
    struct fl_block *block = testbed_block("queue-send", "name", name, "depth", depth, NULL);
    int status;
    pid_t child = fork();
    if (child == 0) {
        if (!lower() || block->type->start(block) != FL_FAILED)
            _exit(1);
        _exit(strstr(block->service->failure, reason) ? 0 : 2);
    }
    assert_int_equal(waitpid(child, &status, 0), child);
    assert_int_equal(status, 0);
    testbed_end(block);
    assert_gone();
}

static bool drop_privileges(void)
{
    struct __user_cap_header_struct header = {.version = _LINUX_CAPABILITY_VERSION_3};
    struct __user_cap_data_struct none[2] = {0};
    return syscall(SYS_capset, &header, none) == 0;
}

static bool lower_limit(void)
{
    return setrlimit(RLIMIT_MSGQUEUE, &(struct rlimit){200, 200}) == 0;
}

/* Seen to fail: "another process holds its lock" and "another block already sends to", whatever the kernel said. */
static void says_why_it_cannot_lock(void **state)
{
    (void)state;
    enum { SENDER = 0, CHANGE = 2 };
    static const struct {
        int error;
        off_t range;
        const char *reason;
    } cases[] = {
        {ENOLCK, CHANGE, "cannot be locked: No locks available"},
        {ENOLCK, SENDER, "cannot be locked: No locks available"},
        {EAGAIN, SENDER, "another block already sends to queue"},
    };
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        struct fl_block *send = testbed_block("queue-send", "name", name, NULL);
        refused_range = cases[i].range;
        lock_error = cases[i].error;
        refuses_to_start(send, cases[i].reason);
        lock_error = 0;
        mq_unlink(name);
    }
}

static void explains_limits(void **state)
{
    (void)state;
    refuses_beyond(lower_limit, "10", "exceed the limit RLIMIT_MSGQUEUE (LimitMSGQUEUE=)");
    /* 10 unless somebody has raised it */
    refuses_beyond(drop_privileges, "1000",
                   "1000 messages of 24 bytes exceed the limits fs.mqueue.msg_max and msgsize_max");
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(carries_every_type),
        cmocka_unit_test(takes_newest_or_in_order),
        cmocka_unit_test(drops_as_told),
        cmocka_unit_test(ages_from_sending),
        cmocka_unit_test(drops_what_waited_before),
        cmocka_unit_test(refuses_foreign_messages),
        cmocka_unit_test(takes_over_a_stale_queue),
        cmocka_unit_test(takes_over_from_the_killed),
        cmocka_unit_test(refuses_a_queue_in_use),
        cmocka_unit_test(makes_anew_what_is_being_removed),
        cmocka_unit_test(is_of_the_group_that_tasks_share),
        cmocka_unit_test(refuses),
        cmocka_unit_test(says_why_it_cannot_lock),
        cmocka_unit_test(explains_limits),
    };
    snprintf(name, sizeof name, "/flotilla-test-%d", (int)getpid());
    int failed = cmocka_run_group_tests(tests, NULL, NULL);
    mq_unlink(name);
    return failed;
}
