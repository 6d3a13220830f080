#define _GNU_SOURCE
#include "claim.h"

#include <errno.h>
#include <grp.h>
#include <pthread.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

enum {
    FIRST_LOGIN = 1000,
    SOCKETS = 8,   /* of a name */
    WAITING = 128, /* processes that may wait for one holder */
    GROUPS = 64,   /* of a process */
};

#define TASKS "control" /* the group of control tasks */

static pthread_once_t once = PTHREAD_ONCE_INIT;
static gid_t tasks = (gid_t)-1; /* the group's number */

static void look_up(void)
{
    const struct group *group = getgrnam(TASKS);
    if (group)
        tasks = group->gr_gid;
}

static bool may_log_in(uid_t user)
{
    return user == 0 || user >= FIRST_LOGIN;
}

bool claim_user_counts(uid_t user)
{
    return may_log_in(geteuid()) || may_log_in(user) || user == geteuid();
}

/* Whether the process at the other end may exclude this one: control tasks have users of their own, and a group. */
static bool counts(int connection, const struct ucred *peer)
{
    gid_t groups[GROUPS];
    socklen_t size = sizeof groups;
    if (claim_user_counts(peer->uid))
        return true;
    if (tasks == (gid_t)-1)
        return false;
    if (peer->gid == tasks)
        return true;
    if (getsockopt(connection, SOL_SOCKET, SO_PEERGROUPS, groups, &size) < 0)
        return false;
    for (size_t i = 0; i < size / sizeof *groups; i++)
        if (groups[i] == tasks)
            return true;
    return false;
}

static socklen_t address_of(const char *kind, const char *key, int number, struct sockaddr_un *address)
{
    char prefix[64];
    size_t length = strlen(key);
    *address = (struct sockaddr_un){.sun_family = AF_UNIX}; /* abstract: the path begins with a zero */
    int used =
        number ? snprintf(prefix, sizeof prefix, "%s/%d/", kind, number) : snprintf(prefix, sizeof prefix, "%s/", kind);
    size_t room = sizeof address->sun_path - 1 - (size_t)used;
    used = snprintf(address->sun_path + 1, sizeof address->sun_path - 1, "%s%s", prefix,
                    key + (length >= room ? length - room + 1 : 0));
    return (socklen_t)(offsetof(struct sockaddr_un, sun_path) + 1 + (size_t)used);
}

/* A listening socket, or -1 with errno: EADDRINUSE where another process has it. */
static int hold(const struct sockaddr_un *address, socklen_t length)
{
    int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (fd < 0 || (bind(fd, (const struct sockaddr *)address, length) == 0 && listen(fd, WAITING) == 0))
        return fd;
    int error = errno;
    close(fd);
    errno = error;
    return -1;
}

/* Who holds the socket. CLAIM_DEAF also where the holder has just ended. */
static enum claim_result look(const struct sockaddr_un *address, socklen_t length, struct claim *claim)
{
    struct ucred peer = {0};
    socklen_t size = sizeof peer;
    enum claim_result found = CLAIM_STRANGERS;
    int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (fd < 0)
        return CLAIM_ERROR;
    if (connect(fd, (const struct sockaddr *)address, length) < 0)
        found = errno == EAGAIN ? CLAIM_BUSY : CLAIM_DEAF;
    else if (getsockopt(fd, SOL_SOCKET, SO_PEERCRED, &peer, &size) == 0 && counts(fd, &peer)) {
        *claim = (struct claim){.fd = fd, .process = peer.pid};
        return CLAIM_HELD;
    }
    close(fd);
    return found;
}

enum claim_result claim_take(const char *kind, const char *key, bool deaf, struct claim *claim)
{
    struct sockaddr_un address;
    int own = -1, number;
    pthread_once(&once, look_up); /* when a block starts: later claims are those of threads */
    *claim = (struct claim){.fd = -1};
    for (number = 0; number < SOCKETS && own < 0; number++) {
        socklen_t length = address_of(kind, key, number, &address);
        own = hold(&address, length);
        if (own >= 0)
            break;
        if (errno != EADDRINUSE)
            return CLAIM_ERROR;
        enum claim_result found = look(&address, length, claim);
        if (found == CLAIM_STRANGERS || (found == CLAIM_DEAF && deaf))
            continue;
        return found;
    }
    if (own < 0)
        return CLAIM_STRANGERS;
    /* Strangers may have let go of a socket since somebody took a later one. Those of earlier ones do not count. */
    for (int later = number + 1; later < SOCKETS; later++) {
        socklen_t length = address_of(kind, key, later, &address);
        enum claim_result found = look(&address, length, claim);
        if (found == CLAIM_HELD || found == CLAIM_BUSY) {
            close(own);
            return found;
        }
    }
    claim->fd = own;
    return CLAIM_OURS;
}
