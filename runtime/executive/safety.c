#define _GNU_SOURCE
#include "safety.h"

#include "core/service.h"

#include <dlfcn.h>
#include <errno.h>
#include <inttypes.h>
#include <poll.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/types.h>
#include <time.h>
#include <ucontext.h>
#include <unistd.h>

enum {
    LIMIT_S = 1,              /* from the first `safe` to the end of the process */
    TERMINATE_S = 10,         /* for `terminate` of a block, which may write files; a service has less */
    PARK_NS = 20 * 1000000,   /* a thread that waits in the kernel cannot be parked, nor can it run a step */
    PARK_POLL_NS = 50 * 1000, /* on one processor the thread gets it meanwhile */
};

/* One signal with two uses: sent by tgkill() it parks a thread, sent by the timer it ends the process. */
#define OWN_SIGNAL SIGRTMIN

static const int fatal_signals[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT, SIGSYS, SIGTRAP};
#define FATAL_SIGNALS (sizeof fatal_signals / sizeof *fatal_signals)

#if defined(__x86_64__)
#define PROGRAM_COUNTER REG_RIP
#else
#define PROGRAM_COUNTER REG_EIP
#endif

_Thread_local const struct fl_block *safety_running;

/* One for the process, as signals are. */
static struct {
    _Atomic(struct task *) task; /* NULL: nothing is to be made safe */
    pid_t process;               /* a child that a block forks has the handlers, but not the task */
    timer_t limit;
    _Atomic size_t left; /* blocks whose `safe` was not called yet */
    _Atomic pid_t stepping, stopping;
    _Atomic(const struct fl_block *) terminating;
    _Atomic bool parked;
} safety;

/* All of the following runs in signal handlers: only what signal-safety(7) allows. */

static void park_stepping(pid_t self)
{
    pid_t thread = atomic_load(&safety.stepping);
    if (!thread || thread == self || tgkill(safety.process, thread, OWN_SIGNAL) < 0)
        return;
    int64_t until_ns = fl_now_ns() + PARK_NS;
    while (!atomic_load(&safety.parked) && fl_now_ns() < until_ns)
        nanosleep(&(struct timespec){.tv_nsec = PARK_POLL_NS}, NULL);
}

/* A thread that fails in a block's `safe` comes here again and continues with the next block. */
static void stop_outputs(void)
{
    pid_t nobody = 0, self = gettid();
    const struct task *task = atomic_load(&safety.task);
    if (!task || getpid() != safety.process)
        return;
    if (!atomic_compare_exchange_strong(&safety.stopping, &nobody, self) && nobody != self)
        for (;;)
            pause(); /* the other thread ends the process */
    atomic_store(&safety.terminating, NULL);
    timer_settime(safety.limit, 0, &(struct itimerspec){.it_value.tv_sec = LIMIT_S}, NULL);
    park_stepping(self);
    while (atomic_load(&safety.left)) {
        const struct task_block *task_block = &task->blocks[atomic_fetch_sub(&safety.left, 1) - 1];
        safety_running = task_block->block;
        safety_reset(task_block);
    }
}

void safety_reset(const struct task_block *task_block)
{
    if (!task_block->started || !task_block->block->type->safe)
        return;
    task_block->block->type->safe(task_block->block);
    atomic_store(&task_block->block->service->made_safe, true);
}

/* Why an actuator's outputs may not be in their reset state; NULL: they are. */
static const char *why_not(const struct task_block *task_block)
{
    const struct fl_service *service = task_block->block->service;
    const char *reason = atomic_load(&service->not_safe);
    if (reason)
        return reason;
    if (task_block->failed)
        return "its start failed";
    if (atomic_load(&service->made_safe))
        return NULL;
    return task_block->started ? "its reset did not end" : "it was not started";
}

static void append(char **out, size_t *left, const char *text)
{
    for (; *text && *left > 1; (*left)--)
        *(*out)++ = *text++;
    **out = '\0';
}

bool safety_outcome(const struct task *task, char *out, size_t size)
{
    size_t actuators = 0, right = 0;
    append(&out, &size, "");
    for (size_t i = 0; i < task->count; i++) {
        if (!task->blocks[i].block->type->safe)
            continue;
        actuators++;
        right += !why_not(&task->blocks[i]);
    }
    if (right == actuators) {
        append(&out, &size, actuators ? "outputs are in their reset state" : "the task has no actuators");
        return true;
    }
    for (size_t i = 0, said = 0; right && i < task->count; i++) {
        if (!task->blocks[i].block->type->safe || why_not(&task->blocks[i]))
            continue;
        append(&out, &size, said++ ? ", " : "outputs of ");
        append(&out, &size, task->blocks[i].block->name);
    }
    append(&out, &size, right ? " are in their reset state, but " : "");
    for (size_t i = 0, said = 0; i < task->count; i++) {
        const char *reason = task->blocks[i].block->type->safe ? why_not(&task->blocks[i]) : NULL;
        if (!reason)
            continue;
        append(&out, &size, said++ ? ", " : "OUTPUTS MAY NOT BE IN THEIR RESET STATE: ");
        append(&out, &size, task->blocks[i].block->name);
        append(&out, &size, " (");
        append(&out, &size, reason);
        append(&out, &size, ")");
    }
    return false;
}

/* What stderr does not accept at once is lost. */
static void say(const char *text)
{
    struct pollfd room = {.fd = STDERR_FILENO, .events = POLLOUT};
    if (poll(&room, 1, 0) > 0 && write(STDERR_FILENO, text, strlen(text)) < 0)
        return;
}

/* Write the state of the outputs. Whether it is as it should be. */
static bool say_outcome(const char *before)
{
    char text[SAFETY_OUTCOME];
    const struct task *task = atomic_load(&safety.task);
    bool safe = !task || safety_outcome(task, text, sizeof text);
    say(before);
    say(task ? text : "no task runs");
    say("\n");
    return safe;
}

/* Write what crashed: the first time, because what follows may be a crash of this. dladdr and snprintf are not in
 * signal-safety(7): where they wait for a lock of the crashed code, the time limit ends the process. */
static void report_crash(int number, const siginfo_t *info, const struct fl_block *running, uintptr_t at)
{
    static atomic_flag reported = ATOMIC_FLAG_INIT;
    char text[512], thread[17] = "";
    Dl_info place = {0};
    const bool sent = info->si_code <= 0 && !(info->si_code == SI_TKILL && info->si_pid == getpid());
    if (sent || atomic_flag_test_and_set(&reported))
        return;
    prctl(PR_GET_NAME, thread);
    dladdr((void *)at, &place); /* NOLINT(performance-no-int-to-ptr): the kernel has it as a number */
    const char *name = sigabbrev_np(number), *file = place.dli_fname ? strrchr(place.dli_fname, '/') : NULL;
    int used = snprintf(text, sizeof text, "%sflotilla: %s %s: SIG%s at address 0x%" PRIxPTR ", in %s+0x%" PRIxPTR,
                        fl_priority(FL_ERROR), running ? "block" : "thread", running ? running->name : thread,
                        name ? name : "?", (uintptr_t)info->si_addr, file ? file + 1 : "code that no file has",
                        at - (uintptr_t)place.dli_fbase);
    if (place.dli_sname && used > 0 && (size_t)used < sizeof text)
        used += snprintf(text + used, sizeof text - (size_t)used, " (%s)", place.dli_sname);
    size_t length = used > 0 && (size_t)used < sizeof text - 1 ? (size_t)used : sizeof text - 2;
    text[length] = '\n';
    if (write(STDERR_FILENO, text, length + 1) < 0)
        return; /* stderr is gone */
}

static void handle(int number, siginfo_t *info, void *context)
{
    const struct fl_block *running = safety_running;
    if (number == OWN_SIGNAL && info->si_code == SI_TIMER) {
        const struct fl_block *block = atomic_load(&safety.terminating);
        say(fl_priority(FL_ERROR));
        say("flotilla: ");
        say(block ? block->name : "the end");
        _exit(say_outcome(block ? " does not end; " : " took too long; ") ? 1 : SAFETY_UNKNOWN);
    }
    if (number == OWN_SIGNAL && info->si_code == SI_TKILL && gettid() == atomic_load(&safety.stepping)) {
        atomic_store(&safety.parked, true);
        for (;;)
            pause();
    }
    stop_outputs();
    report_crash(number, info, running, (uintptr_t)((ucontext_t *)context)->uc_mcontext.gregs[PROGRAM_COUNTER]);
    const struct task *task = atomic_load(&safety.task);
    char text[SAFETY_OUTCOME];
    if (task && getpid() == safety.process && !safety_outcome(task, text, sizeof text)) {
        say(fl_priority(FL_ERROR));
        say_outcome("flotilla: ");
    }
    /* The status, and the core if there is one, say what it died of. */
    signal(number, SIG_DFL);
    raise(number);
}

void safety_abandon(const char *text)
{
    stop_outputs();
    say(fl_priority(FL_ERROR));
    _exit(say_outcome(text) ? 1 : SAFETY_UNKNOWN);
}

static void at_exit(void)
{
    if (atomic_load(&safety.task) && getpid() == safety.process)
        safety_abandon("flotilla: a block has called exit(); ");
}

/* --- not in signal handlers --- */

static void catch_signals(void)
{
    struct sigaction action = {.sa_sigaction = handle, .sa_flags = SA_SIGINFO | SA_ONSTACK | SA_NODEFER};
    safety_orderly_signals(&action.sa_mask);
    sigaction(OWN_SIGNAL, &action, NULL);
    for (size_t i = 0; i < FATAL_SIGNALS; i++)
        sigaction(fatal_signals[i], &action, NULL);
}

void safety_begin(struct task *task)
{
    static bool registered;
    struct sigevent event = {.sigev_notify = SIGEV_SIGNAL, .sigev_signo = OWN_SIGNAL};
    if (timer_create(CLOCK_MONOTONIC, &event, &safety.limit) < 0 ||
        (!registered && (atexit(at_exit) != 0 || at_quick_exit(at_exit) != 0))) {
        perror("flotilla: what makes outputs safe cannot be prepared");
        abort();
    }
    registered = true;
    safety.process = getpid();
    atomic_store(&safety.left, task->count);
    atomic_store(&safety.terminating, NULL);
    atomic_store(&safety.task, task);
    catch_signals();
}

void safety_end(void)
{
    atomic_store(&safety.task, NULL);
    timer_delete(safety.limit);
}

void safety_terminates(const struct fl_block *block)
{
    if (!atomic_load(&safety.task) || atomic_load(&safety.stopping)) /* it never ran, or its last second has begun */
        return;
    atomic_store(&safety.terminating, block);
    timer_settime(safety.limit, 0, &(struct itimerspec){.it_value.tv_sec = TERMINATE_S}, NULL);
    if (!atomic_load(&safety.stopping))
        return;
    /* Another thread has begun to make outputs safe meanwhile: its limit holds. */
    atomic_store(&safety.terminating, NULL);
    timer_settime(safety.limit, 0, &(struct itimerspec){.it_value.tv_sec = LIMIT_S}, NULL);
}

void safety_step_begin(void)
{
    atomic_store(&safety.stepping, gettid());
}

void safety_step_end(void)
{
    atomic_store(&safety.stepping, 0);
}

void safety_orderly_signals(sigset_t *signals)
{
    static const int others[] = {SIGPIPE, SIGCHLD, SIGCONT, SIGURG, SIGWINCH, SIGKILL, SIGSTOP};
    sigfillset(signals);
    sigdelset(signals, OWN_SIGNAL);
    for (size_t i = 0; i < FATAL_SIGNALS; i++)
        sigdelset(signals, fatal_signals[i]);
    for (size_t i = 0; i < sizeof others / sizeof *others; i++)
        sigdelset(signals, others[i]);
}
