/* A child process that does something and then stands still: begin it, wait until it is ready, kill it. */
#ifndef FLOTILLA_CHILD_H
#define FLOTILLA_CHILD_H

#include "testbed.h"

#include <signal.h>
#include <sys/prctl.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <unistd.h>

/* Run `body` as a user in a child, which ends with this process. Returns when it is done. */
static inline pid_t child_begin(uid_t user, void (*body)(void *), void *context)
{
    int ready[2];
    char byte;
    assert_int_equal(pipe(ready), 0);
    pid_t child = fork();
    if (child == 0) {
        if (user != geteuid() && setresuid(user, user, user) != 0)
            _exit(1);
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        body(context); /* _exit() where it fails, which the read below sees */
        (void)!write(ready[1], "", 1);
        pause();
    }
    close(ready[1]);
    assert_int_equal(read(ready[0], &byte, 1), 1);
    close(ready[0]);
    return child;
}

static inline void child_end(pid_t child)
{
    kill(child, SIGKILL);
    waitpid(child, NULL, 0);
}

#endif
