/* The time limits of an end, however two threads' calls of timer_settime follow each other. */
#define _GNU_SOURCE
#include "testbed.h"

#include "core/service.h"
#include "executive/safety.h"

#include <dlfcn.h>
#include <pthread.h>
#include <semaphore.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

static struct {
    sem_t limited, set;
    time_t limit_s; /* that was set last */
    bool meanwhile;
} test;

/* In the child, by the thread that makes outputs safe: once the other thread has set its limit, too, which one is it?
 */
static void safe(struct fl_block *block)
{
    (void)block;
    sem_wait(&test.set);
    _exit((int)test.limit_s);
}

static int step(struct fl_block *block)
{
    (void)block;
    return FL_OK;
}

FL_BLOCK(actuator) = {.abi = FL_ABI, .name = "actuator", .summary = "an actuator", .step = step, .safe = safe};

static void *abandon(void *context)
{
    (void)context;
    safety_abandon("");
}

/* Of the C library; outputs are made safe just before the first call takes effect. */
int timer_settime(timer_t timer, int flags, const struct itimerspec *limit, struct itimerspec *before)
{
    int (*real)(timer_t, int, const struct itimerspec *, struct itimerspec *) =
        (int (*)(timer_t, int, const struct itimerspec *, struct itimerspec *))dlsym(RTLD_NEXT, "timer_settime");
    if (!test.meanwhile) {
        pthread_t thread;
        test.meanwhile = true;
        pthread_create(&thread, NULL, abandon, NULL);
        sem_wait(&test.limited);
    }
    test.limit_s = limit->it_value.tv_sec;
    int result = real(timer, flags, limit, before);
    sem_post(&test.limited);
    return result;
}

/* The thread that ends blocks has found nothing wrong, and then another makes outputs safe. Seen to fail: the limit
 * of the latter, 1 s, became 10 s. */
static void the_shorter_limit_holds(void **state)
{
    (void)state;
    int status;
    pid_t child = fork();
    assert_true(child >= 0);
    if (child == 0) {
        struct task_block task_block = {.block = testbed_block("actuator", NULL), .started = true};
        struct task task = {.blocks = &task_block, .count = 1};
        sem_init(&test.limited, 0, 0);
        sem_init(&test.set, 0, 0);
        safety_begin(&task);
        safety_terminates(task_block.block);
        sem_post(&test.set);
        for (;;)
            pause();
    }
    assert_int_equal(waitpid(child, &status, 0), child);
    assert_true(WIFEXITED(status));
    assert_int_equal(WEXITSTATUS(status), 1);
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(the_shorter_limit_holds)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
