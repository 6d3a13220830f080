#define _GNU_SOURCE
#include "executive.h"

#include "block.h"
#include "device.h"
#include "privilege.h"
#include "safety.h"
#include "schedule.h"
#include "status.h"
#include "watch.h"

#include <errno.h>
#include <inttypes.h>
#include <poll.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/signalfd.h>
#include <systemd/sd-daemon.h>
#include <time.h>
#include <unistd.h>

enum {
    STACK_BYTES = 128 * 1024, /* touched before the first step */
    WATCH_MS = 20,
    CATCH_UP_PERIODS = 10, /* further behind, the rest is left out */
    HOLDER_MS = 1000,      /* to make outputs safe that another process has, until it ends */
    LATE_PERIODS = 5,      /* from one step's end to the next one's: two for a late trigger, three for a late step */
};

#define SECOND_NS INT64_C(1000000000)

struct executive {
    struct task *task;
    const struct run_options *options;
    struct run_result *result;
    struct schedule *schedule;
    struct watch *watch;   /* NULL: nothing is printed */
    struct change *change; /* NULL: parameters stay as they are */
    pthread_t control;
    int ended_fd;
    _Atomic bool stop, ended;
    struct status *status; /* for all other threads */
    int signal;            /* that asked for the end; 0: none did */
    int output_error;      /* errno of stdout */
};

/* --- life of blocks --- */

static void end(struct run_result *result, enum ending ending, const struct fl_block *block, const char *text)
{
    if (result->ending != ENDING_NONE)
        return; /* the first cause counts */
    result->ending = ending;
    snprintf(result->reason, sizeof result->reason, "%s%s%s", block ? block->name : "", block ? ": " : "", text);
}

static bool start_blocks(struct task *task, struct run_result *result)
{
    for (size_t i = 0; i < task->count; i++) {
        struct member *member = &task->members[i];
        if (device_claim(member->block) != FL_OK) {
            end(result, ENDING_FAILED, member->block, member->block->service->failure);
            return false;
        }
        member->started = true; /* terminate also cleans up after a start that failed halfway */
        if (member->block->type->start && member->block->type->start(member->block) != FL_OK) {
            end(result, ENDING_FAILED, member->block, member->block->service->failure);
            return false;
        }
    }
    for (size_t i = 0; i < task->count; i++) {
        struct fl_block *block = task->members[i].block;
        if (block->type->initialize && block->type->initialize(block) != FL_OK) {
            end(result, ENDING_FAILED, block, block->service->failure);
            return false;
        }
    }
    return true;
}

static void make_outputs_safe(struct task *task)
{
    for (size_t i = task->count; i-- > 0;)
        if (task->members[i].started && task->members[i].block->type->safe)
            task->members[i].block->type->safe(task->members[i].block);
}

static void terminate_blocks(struct task *task)
{
    for (size_t i = task->count; i-- > 0;) {
        struct member *member = &task->members[i];
        if (member->started && member->block->type->terminate)
            member->block->type->terminate(member->block);
        member->started = false;
    }
}

unsigned executive_make_safe(struct task *task)
{
    unsigned failures = 0;
    for (size_t i = 0; i < task->count; i++) {
        struct member *member = &task->members[i];
        const struct fl_block_type *type = member->block->type;
        if (!type->safe)
            continue;
        member->block->service->patience_ms = HOLDER_MS;
        member->failed = device_claim(member->block) != FL_OK;
        if (member->failed)
            continue;
        member->started = true;
        member->failed = type->start && type->start(member->block) != FL_OK;
        if (!member->failed)
            type->safe(member->block);
    }
    terminate_blocks(task);
    /* Now that no output waits for whoever reads it. */
    for (size_t i = 0; i < task->count; i++) {
        if (!task->members[i].failed)
            continue;
        fprintf(stderr, "%s: %s\n", task->members[i].block->name, task->members[i].block->service->failure);
        failures++;
    }
    return failures;
}

/* --- control thread --- */

static void touch_stack(void)
{
    volatile unsigned char stack[STACK_BYTES];
    for (size_t i = 0; i < sizeof stack; i += 1024)
        stack[i] = 0;
}

static void sleep_until(int64_t release_ns)
{
    const struct timespec release = {(time_t)(release_ns / SECOND_NS), (long)(release_ns % SECOND_NS)};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &release, NULL) == EINTR)
        continue;
}

/* Wait until a step is due; when it was. `expected_ns`: when it should be, which what triggers it moves.
 *
 * A trigger may come half a period early or three quarters late. Nothing for longer is a step without it, so that there
 * are as many steps as periods and blocks notice the silence; something sooner waits, so that a flood cannot be a flood
 * of steps. What comes later than that makes two steps of this task, and two messages of which the next one may take
 * only the newer; a whole period's patience could not tell one that is late from the next.
 */
static int64_t wait_for_release(struct executive *executive, int64_t *expected_ns)
{
    struct fl_block *trigger = executive->task->trigger;
    const int64_t early_ns = executive->task->period_ns / 2, late_ns = executive->task->period_ns * 3 / 4;
    if (executive->options->no_wait)
        return *expected_ns;
    if (!trigger) {
        sleep_until(*expected_ns);
        return *expected_ns;
    }
    const int64_t earliest_ns = *expected_ns - early_ns, latest_ns = *expected_ns + late_ns;
    sleep_until(earliest_ns);
    int64_t came_ns = trigger->type->await(trigger, latest_ns);
    if (!came_ns) {
        executive->result->timeouts++;
        return latest_ns;
    }
    *expected_ns = came_ns > earliest_ns ? came_ns : earliest_ns;
    return *expected_ns;
}

/* When the step is expected after one that was expected at `expected_ns`, due at `release_ns`, and ended at `now_ns`.
 */
static int64_t next_release(struct executive *executive, int64_t expected_ns, int64_t release_ns, int64_t now_ns,
                            int64_t *in_a_row)
{
    const struct task *task = executive->task;
    struct run_result *result = executive->result;
    int64_t next_ns = release_ns + task->period_ns;
    expected_ns += task->period_ns;
    if (executive->options->no_wait || now_ns <= next_ns) {
        *in_a_row = 0;
        return expected_ns;
    }
    char text[128];
    result->overruns++;
    result->last_overrun = (struct overrun_of_step){result->steps - 1, now_ns, now_ns - next_ns};
    ++*in_a_row;
    if (task->overrun == OVERRUN_STOP_SAFE || (task->overruns && *in_a_row >= task->overruns)) {
        snprintf(text, sizeof text,
                 "step %" PRIu64 " ended %" PRId64 " us after the next was due, %" PRId64 " in a row",
                 result->last_overrun.step, result->last_overrun.late_ns / 1000, *in_a_row);
        end(result, ENDING_OVERRUN, NULL, text);
    }
    int64_t behind = (now_ns - next_ns) / task->period_ns + 1;
    if (task->overrun == OVERRUN_CATCH_UP && behind <= CATCH_UP_PERIODS)
        return expected_ns;
    result->skipped += (uint64_t)behind;
    return expected_ns + behind * task->period_ns;
}

static void *control(void *argument)
{
    struct executive *executive = argument;
    const struct run_options *options = executive->options;
    struct run_result *result = executive->result;
    int64_t in_a_row = 0, period_ns = executive->task->period_ns;
    safety_step_begin();
    touch_stack();
    /* By multiples of the period, so that tasks of one computer keep their phases to each other. */
    int64_t expected_ns = (fl_now_ns() / period_ns + 2) * period_ns + executive->task->phase_ns;
    while (!atomic_load_explicit(&executive->stop, memory_order_relaxed)) {
        int64_t release_ns = wait_for_release(executive, &expected_ns);
        int64_t begin_ns = fl_now_ns();
        if (!options->no_wait)
            statistics_add(&result->jitter, begin_ns - release_ns);
        const struct fl_block *failed = schedule_step(executive->schedule, release_ns);
        int64_t now_ns = fl_now_ns();
        statistics_add(&result->step, now_ns - begin_ns);
        if (failed)
            end(result, ENDING_FAILED, failed, failed->service->failure);
        else if (executive->watch)
            watch_put(executive->watch, result->steps, release_ns, options->no_wait);
        result->steps++;
        if (failed)
            break;
        if (executive->change)
            change_take(executive->change, result->steps);
        if (result->steps == options->steps)
            end(result, ENDING_ASKED, NULL, "all steps are done");
        expected_ns = next_release(executive, expected_ns, release_ns, now_ns, &in_a_row);
        status_put(executive->status, result, now_ns);
        if (result->ending != ENDING_NONE)
            break;
    }
    make_outputs_safe(executive->task);
    safety_step_end();
    atomic_store(&executive->ended, true);
    eventfd_write(executive->ended_fd, 1);
    return NULL;
}

/* --- guarding thread --- */

/* A step that never ends. */
static _Noreturn void abandon(const struct executive *executive, int64_t silent_ns)
{
    char text[512];
    snprintf(text, sizeof text,
             "flotilla: %s: no step ended for %.3f s, after step %" PRIu64 "; outputs are in their reset state\n",
             executive->task->name, (double)silent_ns / 1e9, status_steps(executive->status));
    safety_abandon(text);
}

/* For how long no step may end: as an actuator holds its outputs without a command. */
static int64_t patience_of(const struct executive *executive)
{
    const struct task *task = executive->task;
    int64_t patience_ns = executive->options->no_wait ? INT64_MAX : task_actuator_timeout(task);
    if (patience_ns == INT64_MAX) /* there is none, or time is not measured */
        return 10 * task->period_ns + SECOND_NS;
    return patience_ns > LATE_PERIODS * task->period_ns ? patience_ns : LATE_PERIODS * task->period_ns;
}

/* Until the control thread has ended, or cannot.
 *
 * It wakes when patience would end. Where it does so late itself, it was the computer that stood still, and the control
 * thread gets a part of the time again: it too could not run. */
static void *guard(void *argument)
{
    struct executive *executive = argument;
    const int64_t patience_ns = patience_of(executive), grace_ns = patience_ns / 4;
    struct pollfd ended = {.fd = executive->ended_fd, .events = POLLIN};
    int64_t last_ns = 0, until_ns = 0;
    for (;;) {
        int64_t ended_ns = status_ended_ns(executive->status), now_ns = fl_now_ns();
        if (ended_ns != last_ns)
            until_ns = ended_ns + patience_ns;
        else if (now_ns - until_ns > grace_ns)
            until_ns = now_ns + grace_ns;
        else if (now_ns >= until_ns)
            abandon(executive, now_ns - ended_ns);
        last_ns = ended_ns;
        int64_t left_ns = until_ns > now_ns ? until_ns - now_ns : 0;
        const struct timespec left = {(time_t)(left_ns / SECOND_NS), (long)(left_ns % SECOND_NS)};
        if (ppoll(&ended, 1, &left, NULL) > 0)
            return NULL;
    }
}

/* --- serving thread --- */

/* A reader that has gone ends the task as a signal does. */
static void print_watched(struct executive *executive)
{
    int error = executive->watch ? watch_print(executive->watch) : 0;
    if (error && !executive->output_error) {
        executive->output_error = error;
        atomic_store(&executive->stop, true);
    }
}

static void take_signal(struct executive *executive, int signals_fd)
{
    struct signalfd_siginfo received;
    if (read(signals_fd, &received, sizeof received) != sizeof received)
        return;
    if (!executive->signal)
        executive->signal = (int)received.ssi_signo;
    atomic_store(&executive->stop, true);
}

/* Why it ended, if nothing was wrong with the steps. */
static void end_as_asked(const struct executive *executive)
{
    static const int asking[] = {SIGTERM, SIGINT, SIGHUP, SIGQUIT, SIGTSTP};
    char text[128];
    bool asked = !executive->signal;
    for (size_t i = 0; i < sizeof asking / sizeof *asking; i++)
        asked |= executive->signal == asking[i];
    if (!asked) {
        const char *name = sigabbrev_np(executive->signal);
        snprintf(text, sizeof text, "signal %d%s%s came", executive->signal, name ? ", SIG" : "", name ? name : "");
        end(executive->result, ENDING_FAILED, NULL, text);
    } else if (executive->output_error && executive->output_error != EPIPE) {
        snprintf(text, sizeof text, "what is watched cannot be printed: %s", strerror(executive->output_error));
        end(executive->result, ENDING_FAILED, NULL, text);
    }
    end(executive->result, ENDING_ASKED, NULL, "a signal asked for it, or nobody reads what is watched any more");
}

/* Until the control thread has ended. */
static void serve(struct executive *executive, int signals_fd)
{
    uint64_t usec = 0, last = 0;
    int64_t period_ns = executive->task->period_ns, moved_ns = fl_now_ns(), notified_ns = 0;
    bool guarded = sd_watchdog_enabled(0, &usec) > 0;
    int64_t interval_ns = guarded ? (int64_t)usec * 1000 / 4 : SECOND_NS;
    int64_t wake_ms = executive->watch ? WATCH_MS : interval_ns / 1000000;
    while (!atomic_load(&executive->ended)) {
        struct pollfd waiting[] = {{.fd = signals_fd, .events = POLLIN}, {.fd = executive->ended_fd, .events = POLLIN}};
        poll(waiting, 2, (int)wake_ms);
        print_watched(executive);
        if (waiting[0].revents)
            take_signal(executive, signals_fd);
        int64_t now_ns = fl_now_ns();
        uint64_t steps = status_steps(executive->status);
        /* Only a task that steps may say that it is alive. */
        if (guarded && (steps != last || period_ns > now_ns - moved_ns) && now_ns - notified_ns >= interval_ns) {
            sd_notify(0, "WATCHDOG=1");
            notified_ns = now_ns;
        }
        if (steps != last)
            moved_ns = now_ns;
        last = steps;
    }
}

static int block_signals(void)
{
    sigset_t signals;
    safety_orderly_signals(&signals);
    pthread_sigmask(SIG_BLOCK, &signals, NULL);
    return signalfd(-1, &signals, SFD_CLOEXEC);
}

static void serve_parameters(const struct executive *executive)
{
    int error = executive->options->tuner ? tuner_start(executive->options->tuner, executive->status) : 0;
    if (error)
        fprintf(stderr, "flotilla: %s: no thread for parameters (%s): they stay as they are\n", executive->task->name,
                strerror(error));
}

/* The threads that step and guard; 0 or an errno. Signals that ask for the end are blocked in both. */
static int start_threads(struct executive *executive, int priority, pthread_t *guarding)
{
    struct fl_service stepping = {.priority = priority};
    struct fl_service above = {
        .priority = priority ? privilege_priority(priority + 1, "a step that never ends keeps its processor") : 0};
    int error = fl_service_thread(&stepping, &executive->control, executive->task->name, control, executive);
    if (error)
        return error;
    error = fl_service_thread(&above, guarding, "guard", guard, executive);
    if (error) {
        atomic_store(&executive->stop, true);
        pthread_join(executive->control, NULL);
    }
    return error;
}

static void *run(void *argument)
{
    struct executive *executive = argument;
    struct task *task = executive->task;
    const struct run_options *options = executive->options;
    struct run_result *result = executive->result;
    pthread_t guarding;
    int signals_fd = block_signals();
    safety_begin(task);
    executive->ended_fd = eventfd(0, EFD_CLOEXEC);
    if (options->watched_count)
        executive->watch = watch_create(options->watched, options->watched_count);
    executive->schedule = schedule_create(task);
    executive->change = options->tuner ? tuner_change(options->tuner) : NULL;
    if (!options->no_wait)
        privilege_lock_memory();
    int priority = options->no_wait ? 0 : privilege_priority(task->priority, "steps will be late under load");
    for (size_t i = 0; i < task->count; i++)
        task->members[i].block->service->priority = priority ? priority - 1 : 0;
    if (start_blocks(task, result)) {
        executive->status = status_create(task);
        int error = start_threads(executive, priority, &guarding);
        if (error) {
            end(result, ENDING_FAILED, NULL, strerror(error));
        } else {
            serve_parameters(executive);
            sd_notify(0, "READY=1");
            serve(executive, signals_fd);
            sd_notify(0, "STOPPING=1");
            pthread_join(executive->control, NULL);
            pthread_join(guarding, NULL);
            if (options->tuner)
                tuner_stop(options->tuner);
            print_watched(executive);
        }
    }
    end_as_asked(executive);
    terminate_blocks(task);
    safety_end();
    schedule_report(executive->schedule, task);
    schedule_destroy(executive->schedule);
    status_destroy(executive->status);
    watch_destroy(executive->watch);
    close(executive->ended_fd);
    close(signals_fd);
    return NULL;
}

void executive_run(struct task *task, const struct run_options *options, struct run_result *result)
{
    struct executive executive = {.task = task, .options = options, .result = result};
    *result = (struct run_result){0};
    fl_service_enter(run, &executive);
}

void executive_write_statistics(const struct task *task, const struct run_result *result, FILE *out)
{
    fprintf(out, "{\"task\": \"%s\", \"period_ns\": %" PRId64 ", \"steps\": %" PRIu64, task->name, task->period_ns,
            result->steps);
    fprintf(out, ", \"overruns\": %" PRIu64 ", \"skipped\": %" PRIu64 ", \"timeouts\": %" PRIu64 ",\n \"jitter\": ",
            result->overruns, result->skipped, result->timeouts);
    statistics_write(&result->jitter, out);
    fprintf(out, ",\n \"step\": ");
    statistics_write(&result->step, out);
    fprintf(out, ",\n \"blocks\": {");
    for (size_t i = 0; i < task->count; i++) {
        const struct member *member = &task->members[i];
        fprintf(out, "%s\n  \"%s\": {\"count\": %" PRIu64 ", \"mean_ns\": %" PRId64 ", \"max_ns\": %" PRId64 "}",
                i ? "," : "", member->block->name, member->took.count, member->took.mean_ns, member->took.max_ns);
    }
    fprintf(out, "}}\n");
}
