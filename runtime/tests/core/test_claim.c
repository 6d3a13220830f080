#define _GNU_SOURCE
#include "child.h"
#include "core/claim.h"

#include <dlfcn.h>
#include <grp.h>
#include <poll.h>
#include <stddef.h>
#include <stdio.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

enum { SERVICE = 911, APP = 902, SOCKETS = 8 };
enum how { LISTENS, DEAF, BUSY };

static char key[32];
static unsigned looked_up;

/* Of the C library, counted: it reads files, allocates and waits for locks. */
struct group *getgrnam(const char *group)
{
    struct group *(*real)(const char *) = (struct group * (*)(const char *)) dlsym(RTLD_NEXT, "getgrnam");
    looked_up++;
    return real(group);
}

static struct sockaddr_un address(int number, socklen_t *length)
{
    struct sockaddr_un found = {.sun_family = AF_UNIX};
    int used = number ? snprintf(found.sun_path + 1, sizeof found.sun_path - 1, "flotilla/%d/%s", number, key)
                      : snprintf(found.sun_path + 1, sizeof found.sun_path - 1, "flotilla/%s", key);
    *length = (socklen_t)(offsetof(struct sockaddr_un, sun_path) + 1 + (size_t)used);
    return found;
}

struct held {
    int sockets;
    enum how how;
};

static void hold(void *context)
{
    const struct held *held = context;
    for (int i = 0; i < held->sockets; i++) {
        socklen_t length;
        struct sockaddr_un name = address(i, &length);
        int fd = socket(AF_UNIX, SOCK_STREAM, 0);
        if (bind(fd, (struct sockaddr *)&name, length) != 0 || (held->how != DEAF && listen(fd, 0) != 0))
            _exit(1);
        if (held->how == BUSY && connect(socket(AF_UNIX, SOCK_STREAM, 0), (struct sockaddr *)&name, length) != 0)
            _exit(1);
    }
}

/* A process of a user that holds the first sockets of the name until it is killed. */
static pid_t holder(uid_t user, int sockets, enum how how)
{
    return child_begin(user, hold, &(struct held){sockets, how});
}

static enum claim_result take(bool deaf, struct claim *claim)
{
    bool root = geteuid() == 0;
    if (root)
        assert_int_equal(seteuid(SERVICE), 0);
    enum claim_result result = claim_take("flotilla", key, deaf, claim);
    if (root)
        assert_int_equal(seteuid(0), 0);
    return result;
}

/* As a service's user, which root alone can become. Seen to fail while each holder counted. */
static void passes_over_strangers(void **state)
{
    (void)state;
    static const struct {
        uid_t user;
        int sockets;
        enum how how;
        bool deaf;
        enum claim_result result;
    } cases[] = {
        {SERVICE, 1, LISTENS, true, CLAIM_HELD},
        {1000, 1, LISTENS, true, CLAIM_HELD},
        {0, 1, LISTENS, true, CLAIM_HELD},
        {APP, 1, LISTENS, false, CLAIM_OURS},
        {912, 2, LISTENS, false, CLAIM_OURS}, /* this computer has no group of control tasks */
        {APP, SOCKETS, LISTENS, false, CLAIM_STRANGERS},
        {APP, 1, DEAF, false, CLAIM_DEAF},
        {APP, 1, DEAF, true, CLAIM_OURS},
        {APP, SOCKETS, DEAF, true, CLAIM_STRANGERS},
        {APP, 1, BUSY, true, CLAIM_BUSY},
    };
    if (geteuid() != 0)
        skip();
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        struct claim claim;
        pid_t child = holder(cases[i].user, cases[i].sockets, cases[i].how);
        assert_int_equal(take(cases[i].deaf, &claim), cases[i].result);
        if (cases[i].result == CLAIM_HELD)
            assert_int_equal(claim.process, child);
        assert_int_equal(claim.fd >= 0, cases[i].result == CLAIM_HELD || cases[i].result == CLAIM_OURS);
        close(claim.fd);
        child_end(child);
    }
}

/* Who took a later socket beside a stranger keeps the claim when that goes. Seen to fail where a process looked at no
 * other socket once it had one. */
static void one_has_it_when_strangers_go(void **state)
{
    (void)state;
    struct claim first, second;
    if (geteuid() != 0)
        skip();
    pid_t stranger = holder(APP, 1, LISTENS);
    assert_int_equal(take(false, &first), CLAIM_OURS);
    child_end(stranger);
    assert_int_equal(take(false, &second), CLAIM_HELD);
    assert_int_equal(second.process, getpid());
    close(first.fd);
    struct pollfd gone = {.fd = second.fd};
    assert_int_equal(poll(&gone, 1, 60 * 1000), 1);
    close(second.fd);
    assert_int_equal(take(false, &first), CLAIM_OURS);
    close(first.fd);
}

static void claim_it(void *context)
{
    struct claim claim;
    (void)context;
    if (claim_take("flotilla", key, false, &claim) != CLAIM_OURS)
        _exit(1);
}

/* Each leaves a connection, and there is room for 128. Seen to fail where a holder with no room was passed over: after
 * 129 looks a second process had the device, too. */
static void many_looks_take_it_from_nobody(void **state)
{
    (void)state;
    pid_t child = child_begin(geteuid(), claim_it, NULL);
    for (int i = 0; i < 150; i++) {
        struct claim claim;
        enum claim_result result = take(true, &claim);
        assert_true(result == CLAIM_HELD || result == CLAIM_BUSY);
        if (claim.fd >= 0)
            close(claim.fd);
    }
    child_end(child);
}

/* Threads of a task's blocks claim again and again. Seen to fail: each looked the group of tasks up. */
static void the_group_is_looked_up_by_the_first_claim(void **state)
{
    (void)state;
    struct claim claim;
    if (geteuid() != 0)
        skip();
    unsigned before = looked_up;
    pid_t child = holder(APP, SOCKETS, LISTENS);
    assert_int_equal(take(false, &claim), CLAIM_STRANGERS);
    child_end(child);
    assert_int_equal(before, 1);
    assert_int_equal(looked_up, 1);
}

int main(void)
{
    const struct CMUnitTest all[] = {
        cmocka_unit_test(passes_over_strangers),
        cmocka_unit_test(many_looks_take_it_from_nobody),
        cmocka_unit_test(one_has_it_when_strangers_go),
        cmocka_unit_test(the_group_is_looked_up_by_the_first_claim),
    };
    snprintf(key, sizeof key, "claim-%d", (int)getpid());
    return cmocka_run_group_tests(all, NULL, NULL);
}
