#define _GNU_SOURCE
#include "seccomp.h"

#include "testbed.h"

#include <errno.h>
#include <linux/audit.h>
#include <linux/filter.h>
#include <linux/futex.h>
#include <linux/net.h>
#include <linux/seccomp.h>
#include <poll.h>
#include <signal.h>
#include <stdlib.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

enum { PATIENCE_MS = 2000, WAITED = -1, STEP_FAILED = -2 };

#if defined(__x86_64__)
#define ARCHITECTURE AUDIT_ARCH_X86_64
#elif defined(__i386__)
#define ARCHITECTURE AUDIT_ARCH_I386
#else
#error "name this processor's AUDIT_ARCH"
#endif

#define FIELD(member)        offsetof(struct seccomp_data, member)
#define LOAD(offset)         BPF_STMT(BPF_LD | BPF_W | BPF_ABS, (unsigned)(offset))
#define VERDICT(verdict)     BPF_STMT(BPF_RET | BPF_K, verdict)
#define SKIP_UNLESS(call, n) BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, (unsigned)(call), 0, n)

#define ALLOW(call) SKIP_UNLESS(call, 1), VERDICT(SECCOMP_RET_ALLOW)

/* Where bit `mask` of an argument is set; these are the low 32 bits, on a little-endian processor. The first jump skips
 * all of it: load, test, allow, trap. */
#define ALLOW_WITH(call, argument, mask)                                                                               \
    SKIP_UNLESS(call, 4), LOAD(FIELD(args[argument])), BPF_JUMP(BPF_JMP | BPF_JSET | BPF_K, mask, 0, 1),               \
        VERDICT(SECCOMP_RET_ALLOW), VERDICT(SECCOMP_RET_TRAP)
#define ALLOW_EQUAL(call, argument, value)                                                                             \
    SKIP_UNLESS(call, 4), LOAD(FIELD(args[argument])), BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, (unsigned)(value), 0, 1),   \
        VERDICT(SECCOMP_RET_ALLOW), VERDICT(SECCOMP_RET_TRAP)

static void trapped(int signal, siginfo_t *information, void *context);

static int report_fd = -1;

static bool filter_calls(void)
{
    const struct sock_filter rules[] = {
        LOAD(FIELD(arch)),
        BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, ARCHITECTURE, 1, 0),
        VERDICT(SECCOMP_RET_KILL_PROCESS),
        LOAD(FIELD(nr)),
        ALLOW(SYS_clock_gettime),
#ifdef SYS_clock_gettime64
        ALLOW(SYS_clock_gettime64),
        ALLOW(SYS_mq_timedsend_time64),
        ALLOW(SYS_mq_timedreceive_time64),
#endif
        ALLOW(SYS_mq_timedsend),
        ALLOW(SYS_mq_timedreceive),
        ALLOW(SYS_exit_group),
        ALLOW_WITH(SYS_sendto, 3, MSG_DONTWAIT),
        ALLOW_WITH(SYS_sendmsg, 2, MSG_DONTWAIT),
        ALLOW_WITH(SYS_recvfrom, 3, MSG_DONTWAIT),
        ALLOW_WITH(SYS_recvmsg, 2, MSG_DONTWAIT),
        ALLOW(SYS_getsockopt),
        ALLOW_EQUAL(SYS_futex, 1, FUTEX_WAKE_PRIVATE),
        ALLOW_EQUAL(SYS_write, 0, report_fd),
#ifdef SYS_socketcall
        /* The C library's way on i386; the flags lie in memory, out of a filter's sight. */
        SKIP_UNLESS(SYS_socketcall, 11),
        LOAD(FIELD(args[0])),
        ALLOW(SYS_SENDTO),
        ALLOW(SYS_SENDMSG),
        ALLOW(SYS_RECVFROM),
        ALLOW(SYS_RECVMSG),
        ALLOW(SYS_GETSOCKOPT),
#endif
        VERDICT(SECCOMP_RET_TRAP),
    };
    const struct sock_fprog program = {.len = sizeof rules / sizeof rules[0],
                                       .filter = (struct sock_filter *)(uintptr_t)rules};
    const struct sigaction action = {.sa_sigaction = trapped, .sa_flags = SA_SIGINFO};
    return sigaction(SIGSYS, &action, NULL) == 0 && prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0 &&
           prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &program) == 0;
}

/* One number tells the parent how it went; the end of the pipe without one, that the child died of something else. */
static void report(int outcome)
{
    ssize_t written = write(report_fd, &outcome, sizeof outcome);
    /* Not _exit(): before a call that does not return AddressSanitizer makes one of its own. */
    syscall(SYS_exit_group, written == sizeof outcome ? 0 : 1);
}

static void trapped(int signal, siginfo_t *information, void *context)
{
    (void)signal, (void)context;
    report(information->si_syscall);
}

int forbidden_call(void (*run)(void *context), void *context)
{
    int ends[2], outcome = WAITED, status;
    assert_int_equal(pipe(ends), 0);
    pid_t child = fork();
    assert_true(child >= 0);
    if (child == 0) {
        report_fd = ends[1];
        if (!filter_calls())
            _exit(1);
        run(context);
        report(0);
    }
    close(ends[1]);
    struct pollfd waiting = {.fd = ends[0], .events = POLLIN};
    bool ended = poll(&waiting, 1, PATIENCE_MS) == 1;
    ssize_t got = ended ? read(ends[0], &outcome, sizeof outcome) : 0;
    if (!ended)
        kill(child, SIGKILL);
    waitpid(child, &status, 0);
    close(ends[0]);
    if (ended && got != sizeof outcome)
        fail_msg("the child died of signal %d, status %d", WTERMSIG(status), WEXITSTATUS(status));
    return outcome;
}

struct steps {
    struct fl_block *block;
    unsigned count;
};

static void take_steps(void *context)
{
    const struct steps *steps = context;
    for (unsigned i = 0; i < steps->count; i++)
        if (testbed_step(steps->block) != FL_OK)
            report(STEP_FAILED);
}

void steps_under_seccomp(struct fl_block *block, unsigned steps)
{
    int call = forbidden_call(take_steps, &(struct steps){block, steps});
    if (call == STEP_FAILED)
        fail_msg("a step of %s failed", block->type->name);
    if (call == WAITED)
        fail_msg("a step of %s waited", block->type->name);
    if (call > 0)
        fail_msg("a step of %s made system call %d", block->type->name, call);
}
