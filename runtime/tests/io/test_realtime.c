/* The steps of this folder make no call that may block; and the check notices those that do. */
#define _GNU_SOURCE
#include "testbed.h"

#include "blocks/devices/ports.h"
#include "seccomp.h"

#include <fcntl.h>
#include <mqueue.h>
#include <netinet/in.h>
#include <pthread.h>
#include <stdio.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

/* --- the check itself --- */

static void reads_clocks(void *context)
{
    struct timespec now;
    (void)context;
    clock_gettime(CLOCK_MONOTONIC, &now);
    syscall(SYS_clock_gettime, CLOCK_MONOTONIC, &now); /* as where the vDSO cannot */
}

static void sleeps(void *context)
{
    (void)context;
    nanosleep(&(struct timespec){.tv_nsec = 1}, NULL);
}

static void opens(void *context)
{
    (void)context;
    open("/dev/null", O_RDONLY | O_CLOEXEC);
}

static void writes(void *context)
{
    (void)context;
    ssize_t ignored = write(STDOUT_FILENO, "", 0);
    (void)ignored;
}

/* Of a mutex that the process holds already. */
static void locks(void *context)
{
    pthread_mutex_lock(context);
}

static void receives(void *context)
{
    char byte;
    recv(*(int *)context, &byte, 1, 0);
}

static void receives_at_once(void *context)
{
    char byte;
    recv(*(int *)context, &byte, 1, MSG_DONTWAIT);
}

static void takes_message(void *context)
{
    char bytes[8];
    mq_receive(*(mqd_t *)context, bytes, sizeof bytes, NULL);
}

static void notices_calls_that_block(void **state)
{
    (void)state;
    pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
    int pair[2];
    assert_int_equal(socketpair(AF_UNIX, SOCK_DGRAM, 0, pair), 0);
    pthread_mutex_lock(&mutex);
    assert_int_equal(forbidden_call(reads_clocks, NULL), 0);
    assert_int_equal(forbidden_call(receives_at_once, &pair[0]), 0);
    int slept = forbidden_call(sleeps, NULL);
    assert_true(slept == SYS_nanosleep || slept == SYS_clock_nanosleep
#ifdef SYS_clock_nanosleep_time64
                || slept == SYS_clock_nanosleep_time64
#endif
    );
    assert_int_equal(forbidden_call(opens, NULL), SYS_openat);
    assert_int_equal(forbidden_call(writes, NULL), SYS_write);
    assert_int_equal(forbidden_call(locks, &mutex), SYS_futex);
#ifdef SYS_socketcall
    assert_int_equal(forbidden_call(receives, &pair[0]), -1); /* seen by its waiting */
#else
    assert_int_equal(forbidden_call(receives, &pair[0]), SYS_recvfrom);
#endif
    pthread_mutex_unlock(&mutex);
    close(pair[0]);
    close(pair[1]);
}

static void notices_a_queue_that_waits(void **state)
{
    (void)state;
    char name[32];
    struct mq_attr attributes = {.mq_maxmsg = 1, .mq_msgsize = 8};
    snprintf(name, sizeof name, "/flotilla-wait-%d", (int)getpid());
    mqd_t waits = mq_open(name, O_RDWR | O_CREAT | O_CLOEXEC, 0600, &attributes);
    mqd_t returns = mq_open(name, O_RDWR | O_NONBLOCK | O_CLOEXEC);
    mq_unlink(name);
    assert_int_equal(forbidden_call(takes_message, &waits), -1);
    assert_int_equal(forbidden_call(takes_message, &returns), 0);
    mq_close(waits);
    mq_close(returns);
}

static int sleeping_step(struct fl_block *block)
{
    (void)block;
    sleeps(NULL);
    return FL_OK;
}

FL_BLOCK(sleeper) = {.abi = FL_ABI, .name = "sleeper", .summary = "sleeps in its step", .step = sleeping_step};

static void take_step(void *context)
{
    testbed_step(context);
}

static void notices_a_step_that_sleeps(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("sleeper", NULL);
    testbed_begin(block);
    assert_true(forbidden_call(take_step, block) > 0);
    testbed_end(block);
}

/* --- the blocks --- */

static void udp_steps(void **state)
{
    (void)state;
    struct sockaddr_in free_one = {.sin_family = AF_INET};
    socklen_t size = sizeof free_one;
    char port[8];
    int fd = socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    assert_int_equal(bind(fd, (struct sockaddr *)&free_one, sizeof free_one), 0);
    assert_int_equal(getsockname(fd, (struct sockaddr *)&free_one, &size), 0);
    close(fd);
    snprintf(port, sizeof port, "%u", ntohs(free_one.sin_port));
    struct fl_block *receive =
        testbed_block("udp-receive", "port", port, "local_address", "127.0.0.1", "length", "64", NULL);
    struct fl_block *send = testbed_block("udp-send", "address", "127.0.0.1", "port", port, "length", "64", NULL);
    struct fl_block *igps = testbed_block("igps", "port", port, "local_address", "127.0.0.2", NULL);
    testbed_begin(receive);
    testbed_begin(send);
    testbed_begin(igps);
    steps_under_seccomp(receive, 3); /* nothing is there */
    steps_under_seccomp(igps, 3);
    steps_under_seccomp(send, 5000); /* more than the receiver has room for */
    steps_under_seccomp(receive, 100);
    testbed_end(igps);
    testbed_end(send);
    testbed_end(receive);
}

static void queue_steps(void **state)
{
    (void)state;
    char name[32];
    snprintf(name, sizeof name, "/flotilla-steps-%d", (int)getpid());
    struct fl_block *send = testbed_block("queue-send", "name", name, NULL);
    struct fl_block *receive = testbed_block("queue-receive", "name", name, NULL);
    testbed_begin(send);
    testbed_begin(receive);
    steps_under_seccomp(receive, 3); /* empty */
    steps_under_seccomp(send, 100);  /* full */
    steps_under_seccomp(receive, 3);
    testbed_end(receive);
    testbed_end(send);
    send = testbed_block("queue-send", "name", name, "full", "drop-newest", NULL);
    testbed_begin(send);
    steps_under_seccomp(send, 100);
    testbed_end(send);
}

static uint8_t registers[8];

static int permit(uint16_t first, uint16_t count, bool on)
{
    (void)first, (void)count, (void)on;
    return 0;
}

static uint8_t in(uint16_t port)
{
    return registers[port & 7];
}

static void out(uint16_t port, uint8_t value)
{
    registers[port & 7] = value;
}

static void make_safe(void *context)
{
    struct fl_block *block = context;
    block->type->safe(block);
}

static void ir104_steps(void **state)
{
    (void)state;
    static const struct port_space fake = {permit, in, out};
    port_space = &fake;
    struct fl_block *block = testbed_block("ir104-pbf", "channels", "1,2,3", NULL);
    testbed_begin(block);
    steps_under_seccomp(block, 100);
    assert_int_equal(forbidden_call(make_safe, block), 0);
    testbed_end(block);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(notices_calls_that_block),
        cmocka_unit_test(notices_a_queue_that_waits),
        cmocka_unit_test(notices_a_step_that_sleeps),
        cmocka_unit_test(udp_steps),
        cmocka_unit_test(queue_steps),
        cmocka_unit_test(ir104_steps),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
