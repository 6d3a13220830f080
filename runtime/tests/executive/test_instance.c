#define _GNU_SOURCE
#include "child.h"
#include "executive/instance.h"

#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/file.h>
#include <sys/prctl.h>
#include <sys/stat.h>
#include <unistd.h>

static char path[] = "/tmp/flotilla-instance-XXXXXX";

struct lock {
    int fd, operation;
};

static void hold(void *context)
{
    const struct lock *lock = context;
    if (flock(lock->fd, lock->operation) != 0)
        _exit(1);
    prctl(PR_SET_DUMPABLE, 0); /* most of its files in /proc belong to root then */
}

/* A process of a user that holds a lock on the file until it is killed. */
static pid_t locked_by(uid_t user, int operation)
{
    struct lock lock = {open(path, O_RDONLY), operation}; /* here, because the user may not open it */
    assert_true(lock.fd >= 0);
    pid_t child = child_begin(user, hold, &lock);
    close(lock.fd);
    return child;
}

static void names_who_runs_it(void **state)
{
    (void)state;
    const uid_t users[] = {geteuid(), 1000, 902};
    for (size_t i = 0; i < (geteuid() == 0 ? 3 : 1); i++) {
        pid_t child = locked_by(users[i], LOCK_EX);
        assert_int_equal(instance_lock(path), child);
        child_end(child);
    }
}

/* As a service's user, which root alone can become. Seen to fail while each lock counted. */
static void heeds_no_lock_of_others_as_a_service(void **state)
{
    (void)state;
    static const struct {
        uid_t user;
        int operation;
        bool heeded;
    } cases[] = {{902, LOCK_EX, false}, {902, LOCK_SH, false}, {912, LOCK_EX, false},
                 {911, LOCK_EX, true},  {1000, LOCK_EX, true}, {0, LOCK_EX, true}};
    assert_int_equal(chmod(path, 0644), 0);
    for (size_t i = 0; i < sizeof cases / sizeof cases[0] && geteuid() == 0; i++) {
        pid_t child = locked_by(cases[i].user, cases[i].operation);
        assert_int_equal(seteuid(911), 0);
        int process = instance_lock(path);
        assert_int_equal(seteuid(0), 0);
        assert_int_equal(process, cases[i].heeded ? child : 0);
        child_end(child);
    }
}

static void says_what_is_wrong(void **state)
{
    (void)state;
    assert_int_equal(instance_lock("/nonexistent"), -1);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(names_who_runs_it),
        cmocka_unit_test(heeds_no_lock_of_others_as_a_service),
        cmocka_unit_test(says_what_is_wrong),
    };
    close(mkstemp(path));
    int failed = cmocka_run_group_tests(tests, NULL, NULL);
    unlink(path);
    return failed;
}
