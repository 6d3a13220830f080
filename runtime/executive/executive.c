#define _GNU_SOURCE
#include "executive.h"

#include "block.h"
#include "device.h"
#include "privilege.h"
#include "rates.h"
#include "safety.h"
#include "sampler.h"
#include "schedule.h"
#include "status.h"
#include "tuner.h"

#include "core/service.h"

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
    WATCH_MS = 20,
    CATCH_UP_PERIODS = 10, /* further behind, the remaining steps are skipped */
    HOLDER_MS = 1000,      /* wait for another process to release a device, when only making outputs safe */
    BURST_PERIODS = 2,     /* that a triggered task may be ahead of its mean rate */
    FASTER = 20,           /* one part in so many, by which the mean rate may exceed the declared one: see `pay` */
    LATE_PERIODS = 5, /* from the end of a step to the end of the next: two for a late trigger, three for a late step */
    HUNG_PERIODS = 10, /* without a step, where no actuator time-out sets a limit */
};

#define SECOND_NS INT64_C(1000000000)
#define NAP_NS    (SECOND_NS / 2) /* longest sleep before the task looks whether it has to end */

struct executive {
    struct task *task;
    const struct run_options *options;
    struct run_result *result;
    struct schedule *schedule;
    struct sampler *watch; /* NULL: nothing is printed */
    struct change *change; /* NULL: parameters stay as they are */
    struct scope *scope;   /* NULL: nobody can watch signals */
    pthread_t control;
    int ended_fd;
    _Atomic bool stop, ended;
    struct status *status; /* read by all other threads */
    int signal;            /* the signal that ended the task; 0: none */
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
        struct task_block *task_block = &task->blocks[i];
        if (device_claim(task_block->block) != FL_OK) {
            end(result, ENDING_FAILED, task_block->block, task_block->block->service->failure);
            task_block->failed = true;
            return false;
        }
        safety_running = task_block->block;
        task_block->started = true; /* terminate also cleans up after a start that failed halfway */
        if (task_block->block->type->start && task_block->block->type->start(task_block->block) != FL_OK) {
            end(result, ENDING_FAILED, task_block->block, task_block->block->service->failure);
            task_block->failed = true;
            return false;
        }
    }
    for (size_t i = 0; i < task->count; i++) {
        struct fl_block *block = task->blocks[i].block;
        safety_running = block;
        if (block->type->initialize && block->type->initialize(block) != FL_OK) {
            end(result, ENDING_FAILED, block, block->service->failure);
            return false;
        }
    }
    safety_running = NULL;
    return true;
}

static void make_outputs_safe(struct task *task)
{
    for (size_t i = task->count; i-- > 0;)
        safety_reset(&task->blocks[i]);
}

static void terminate_blocks(struct task *task)
{
    for (size_t i = task->count; i-- > 0;) {
        struct task_block *task_block = &task->blocks[i];
        safety_running = task_block->block;
        if (task_block->started && task_block->block->type->terminate) {
            safety_terminates(task_block->block);
            task_block->block->type->terminate(task_block->block);
        }
        task_block->started = false;
    }
}

bool executive_make_safe(struct task *task)
{
    char text[SAFETY_OUTCOME];
    for (size_t i = 0; i < task->count; i++) {
        struct task_block *task_block = &task->blocks[i];
        const struct fl_block_type *type = task_block->block->type;
        if (!type->safe)
            continue;
        task_block->block->service->patience_ms = HOLDER_MS;
        task_block->failed = device_claim(task_block->block) != FL_OK;
        if (task_block->failed)
            continue;
        task_block->started = true;
        task_block->failed = type->start && type->start(task_block->block) != FL_OK;
        if (!task_block->failed)
            safety_reset(task_block);
    }
    terminate_blocks(task);
    /* Report only after all outputs are safe: the reader of stderr may be slow. */
    for (size_t i = 0; i < task->count; i++)
        if (task->blocks[i].failed)
            fprintf(stderr, "%s%s: %s\n", fl_priority(FL_ERROR), task->blocks[i].block->name,
                    task->blocks[i].block->service->failure);
    bool safe = safety_outcome(task, text, sizeof text);
    if (!safe)
        fprintf(stderr, "%sflotilla: %s: %s\n", fl_priority(FL_ERROR), task->name, text);
    return safe;
}

/* --- control thread --- */

/* Bring the slower rates of blocks to the processor of this thread, where priorities decide which of them runs. */
static void gather_rates(const struct executive *executive)
{
    for (size_t i = 0; i < executive->task->count; i++) {
        const struct fl_block *block = executive->task->blocks[i].block;
        int error = block->service->rates && !block->service->rates_in_turn ? rates_gather(block) : 0;
        if (!error)
            continue;
        fprintf(stderr, "%s%s: its rates cannot share one processor (%s): each step waits for the slower ones\n",
                fl_priority(FL_WARNING), block->name, strerror(error));
        rates_in_turn(block);
    }
}

static void relax_rates(const struct task *task)
{
    for (size_t i = 0; i < task->count; i++)
        rates_relax(task->blocks[i].block);
}

/* A slower rate of a block still runs when it is due again. */
static void rate_overran(void *context, int64_t late_ns)
{
    const struct executive *executive = context;
    executive->result->overruns++;
    executive->result->last_overrun = (struct overrun_of_step){executive->result->steps, fl_now_ns(), late_ns};
}

static bool asked_to_stop(struct executive *executive)
{
    return atomic_load_explicit(&executive->stop, memory_order_relaxed);
}

static void sleep_until(int64_t wake_ns)
{
    const struct timespec wake = {(time_t)(wake_ns / SECOND_NS), (long)(wake_ns % SECOND_NS)};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &wake, NULL) == EINTR)
        continue;
}

/* Sleep until that time, or until the task has to end. A period may exceed the watchdog interval of the service
 * manager. */
static void sleep_unless_stopped(struct executive *executive, int64_t wake_ns)
{
    int64_t nap_ns;
    while (!asked_to_stop(executive) && (nap_ns = fl_now_ns() + NAP_NS) < wake_ns)
        sleep_until(nap_ns);
    if (!asked_to_stop(executive))
        sleep_until(wake_ns);
}

/* The same for the trigger. Returns when it fired, or 0 on time-out. */
static int64_t await_unless_stopped(struct executive *executive, struct fl_block *trigger, int64_t latest_ns)
{
    int64_t came_ns = 0, nap_ns;
    while (!asked_to_stop(executive) && !came_ns && (nap_ns = fl_now_ns() + NAP_NS) < latest_ns)
        came_ns = trigger->type->await(trigger, nap_ns);
    return came_ns || asked_to_stop(executive) ? came_ns : trigger->type->await(trigger, latest_ns);
}

/* When a step of a triggered task should be due, which each trigger event moves; and from when on it may be due, so
 * that the task does not step faster than its period in the mean. */
struct pace {
    int64_t expected_ns, soonest_ns;
};

/* A step is due at `release_ns`: pay nearly a period for it. Periods without a step count for some time. An event that
 * comes late costs a step more than its sender made, and until that is paid for, events of the sender's rate wait, up
 * to a period: with a twentieth less than the period for each step, they are followed at once again after 20 steps. */
static int64_t pay(struct executive *executive, struct pace *pace, int64_t release_ns)
{
    const int64_t period_ns = executive->task->period_ns, least_ns = release_ns - BURST_PERIODS * period_ns;
    pace->soonest_ns = (pace->soonest_ns > least_ns ? pace->soonest_ns : least_ns) + period_ns - period_ns / FASTER;
    return release_ns;
}

/* Wait until a step is due. Returns when it was due.
 *
 * The trigger may fire from half a period early to three quarters of a period late. On trigger time-out the task steps
 * without new input, so there are as many steps as periods, and blocks notice the silence. An event that comes sooner
 * waits, so a flood of messages does not become a flood of steps. An event later than that leads to two steps and two
 * messages, of which the next task may take only the newer. Waiting for a whole period could not distinguish a late
 * event from the next one. Events that come faster than the period wait until the mean of steps permits the next; the
 * newest is taken then.
 */
static int64_t wait_for_release(struct executive *executive, struct pace *pace)
{
    struct fl_block *trigger = executive->task->trigger;
    const int64_t early_ns = executive->task->period_ns / 2, late_ns = executive->task->period_ns * 3 / 4;
    if (executive->options->no_wait)
        return pace->expected_ns;
    if (!trigger) {
        sleep_unless_stopped(executive, pace->expected_ns);
        return pace->expected_ns;
    }
    const int64_t early = pace->expected_ns - early_ns, latest_ns = pace->expected_ns + late_ns;
    const int64_t earliest_ns = early > pace->soonest_ns ? early : pace->soonest_ns;
    sleep_unless_stopped(executive, earliest_ns);
    int64_t came_ns = await_unless_stopped(executive, trigger, latest_ns);
    if (!came_ns) {
        executive->result->timeouts += !asked_to_stop(executive);
        return pay(executive, pace, latest_ns);
    }
    pace->expected_ns = came_ns > earliest_ns ? came_ns : earliest_ns;
    return pay(executive, pace, pace->expected_ns);
}

/* How late steps end. */
struct lateness {
    int64_t in_a_row; /* overruns, without those of steps that catch up */
    int64_t late_ns;  /* of the last step, after the next was due; what was skipped since is taken off */
};

/* When the next step is expected, after one that was expected at `expected_ns`, due at `release_ns`, and ended at
 * `now_ns`. A step that ends late, but less so than the one before it, catches up: of a stall it is no further overrun
 * in a row. */
static int64_t next_release(struct executive *executive, int64_t expected_ns, int64_t release_ns, int64_t now_ns,
                            struct lateness *lateness)
{
    const struct task *task = executive->task;
    struct run_result *result = executive->result;
    int64_t next_ns = release_ns + task->period_ns;
    expected_ns += task->period_ns;
    if (executive->options->no_wait || now_ns <= next_ns) {
        *lateness = (struct lateness){0};
        return expected_ns;
    }
    char text[128];
    int64_t late_ns = now_ns - next_ns;
    result->overruns++;
    result->last_overrun = (struct overrun_of_step){result->steps - 1, now_ns, late_ns};
    /* With a trigger each step has a release of its own, so none catches up. */
    lateness->in_a_row += task->trigger || late_ns > lateness->late_ns;
    lateness->late_ns = late_ns;
    if (task->overrun == OVERRUN_STOP_SAFE || (task->overruns && lateness->in_a_row >= task->overruns)) {
        snprintf(text, sizeof text,
                 "step %" PRIu64 " ended %" PRId64 " us after the next was due, %" PRId64 " in a row",
                 result->last_overrun.step, late_ns / 1000, lateness->in_a_row);
        end(result, ENDING_OVERRUN, NULL, text);
    }
    int64_t behind = late_ns / task->period_ns + 1;
    if (task->overrun == OVERRUN_CATCH_UP && behind <= CATCH_UP_PERIODS)
        return expected_ns;
    result->skipped += (uint64_t)behind;
    lateness->late_ns -= behind * task->period_ns;
    return expected_ns + behind * task->period_ns;
}

static void *control(void *argument)
{
    struct executive *executive = argument;
    const struct run_options *options = executive->options;
    struct run_result *result = executive->result;
    int64_t period_ns = executive->task->period_ns;
    struct lateness lateness = {0};
    safety_step_begin();
    privilege_touch_stack();
    gather_rates(executive);
    /* Skip whole periods, so that the tasks of one computer keep their phases relative to each other. */
    struct pace pace = {.expected_ns = (fl_now_ns() / period_ns + 2) * period_ns + executive->task->phase_ns};
    while (!asked_to_stop(executive)) {
        int64_t release_ns = wait_for_release(executive, &pace);
        if (asked_to_stop(executive))
            break; /* this step is not due yet */
        int64_t begin_ns = fl_now_ns();
        if (!options->no_wait)
            statistics_add(&result->jitter, begin_ns - release_ns);
        const struct fl_block *failed = schedule_step(executive->schedule, release_ns);
        if (!failed && executive->scope)
            scope_put(executive->scope, result->steps, release_ns);
        int64_t now_ns = fl_now_ns(); /* what watchers cost counts as the step's */
        statistics_add(&result->step, now_ns - begin_ns);
        if (failed)
            end(result,
                failed->service->ended          ? ENDING_DONE
                : failed->service->overrun_ends ? ENDING_OVERRUN
                                                : ENDING_FAILED,
                failed, failed->service->failure);
        else if (executive->watch)
            sampler_put(executive->watch, result->steps, release_ns, options->no_wait);
        result->steps++;
        if (failed)
            break;
        if (executive->change)
            change_take(executive->change, result->steps);
        if (result->steps == options->steps)
            end(result, ENDING_ASKED, NULL, "all steps are done");
        pace.expected_ns = next_release(executive, pace.expected_ns, release_ns, now_ns, &lateness);
        status_put(executive->status, result, now_ns);
        if (result->ending != ENDING_NONE)
            break;
    }
    make_outputs_safe(executive->task);
    relax_rates(executive->task);
    safety_step_end();
    atomic_store(&executive->ended, true);
    eventfd_write(executive->ended_fd, 1);
    return NULL;
}

/* --- guarding thread --- */

/* End the process because a step does not end. */
static _Noreturn void abandon(const struct executive *executive, int64_t silent_ns)
{
    char text[512];
    snprintf(text, sizeof text, "flotilla: %s: no step ended for %.3f s, after step %" PRIu64 "; ",
             executive->task->name, (double)silent_ns / 1e9, status_steps(executive->status));
    safety_abandon(text);
}

/* How long the task may go without the end of a step: as long as an actuator holds its outputs without a command. */
static int64_t patience_of(const struct executive *executive)
{
    const struct task *task = executive->task;
    int64_t patience_ns = executive->options->no_wait ? INT64_MAX : task_actuator_timeout(task);
    if (patience_ns == INT64_MAX) /* no actuator, or time is not measured */
        return HUNG_PERIODS * task->period_ns + SECOND_NS;
    return patience_ns > LATE_PERIODS * task->period_ns ? patience_ns : LATE_PERIODS * task->period_ns;
}

/* Guard until the control thread has ended, or end the process because it cannot end.
 *
 * The guard wakes when the time limit expires. If the guard itself wakes late, the whole computer was stopped, and the
 * control thread could not run either: it gets part of the limit again.
 */
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
        if (ppoll(&ended, 1, &(struct timespec){(time_t)(left_ns / SECOND_NS), (long)(left_ns % SECOND_NS)}, NULL) > 0)
            return NULL;
    }
}

/* --- serving thread --- */

/* End the task when the reader of its output has gone, as a signal would. */
static void print_watched(struct executive *executive)
{
    if (!executive->watch)
        return;
    for (const struct row *row; (row = sampler_take(executive->watch));)
        sampler_write(executive->watch, row, stdout);
    errno = 0;
    if ((fflush(stdout) != 0 || ferror(stdout)) && !executive->output_error) {
        executive->output_error = errno ? errno : EPIPE;
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

/* Why the task ended, where no step failed. */
static void end_as_asked(const struct executive *executive)
{
    static const int asking[] = {SIGTERM, SIGINT, SIGHUP, SIGQUIT, SIGTSTP};
    char text[128];
    bool asked = !executive->signal;
    for (size_t i = 0; i < sizeof asking / sizeof *asking; i++)
        asked |= executive->signal == asking[i];
    if (!asked) {
        const char *name = sigabbrev_np(executive->signal);
        snprintf(text, sizeof text, "received signal %d%s%s", executive->signal, name ? ", SIG" : "", name ? name : "");
        end(executive->result, ENDING_FAILED, NULL, text);
    } else if (executive->output_error && executive->output_error != EPIPE) {
        snprintf(text, sizeof text, "what is watched cannot be printed: %s", strerror(executive->output_error));
        end(executive->result, ENDING_FAILED, NULL, text);
    }
    end(executive->result, ENDING_ASKED, NULL, "a signal came, or the reader of the watched signals has gone");
}

/* Serve until the control thread has ended. */
static void serve(struct executive *executive, int signals_fd)
{
    uint64_t usec = 0, last = 0;
    int64_t moved_ns = fl_now_ns(), notified_ns = 0;
    const int64_t patience_ns = HUNG_PERIODS * executive->task->period_ns;
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
        /* Only a task that steps may report that it is alive. When it does not step, the guard acts first. */
        if (guarded && (steps != last || patience_ns > now_ns - moved_ns) && now_ns - notified_ns >= interval_ns) {
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
        fprintf(stderr, "%sflotilla: %s: no thread for parameters (%s): they stay as they are\n",
                fl_priority(FL_WARNING), executive->task->name, strerror(error));
}

/* Move to the task's processor, before anything is started that has to run there. */
static bool take_processor(const struct task *task, struct run_result *result)
{
    char text[128];
    int error = task->cpu == TASK_ANY_CPU ? 0 : privilege_processor(task->cpu);
    if (!error)
        return true;
    snprintf(text, sizeof text, "cpu: %d: the task cannot run there (%s); this computer has processors 0 to %ld",
             task->cpu, strerror(error), sysconf(_SC_NPROCESSORS_CONF) - 1);
    end(result, ENDING_FAILED, NULL, text);
    return false;
}

/* Start the control thread and its guard; 0 or an errno. Signals that end the task are blocked in both. */
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
        executive->watch = sampler_create(options->watched, options->watched_count);
    executive->schedule = schedule_create(task);
    executive->change = options->tuner ? tuner_change(options->tuner) : NULL;
    executive->scope = options->tuner ? tuner_scope(options->tuner) : NULL;
    if (!options->no_wait)
        privilege_lock_memory();
    int priority = options->no_wait ? 0 : privilege_priority(task->priority, "steps will be late under load");
    for (size_t i = 0; i < task->count; i++) {
        struct fl_service *service = task->blocks[i].block->service;
        service->priority = priority ? priority - 1 : 0;
        service->rates_in_turn = !priority;
        service->wait = options->service && task->restart == RESTART_WAIT ? FL_WAIT_BEGUN : FL_WAIT_NOT;
        service->overruns = task->overrun == OVERRUN_STOP_SAFE ? 1 : task->overruns;
        service->overran = rate_overran;
        service->overran_context = executive;
    }
    bool started = (options->no_wait || take_processor(task, result)) && start_blocks(task, result);
    if (!started)
        make_outputs_safe(task);
    if (started) {
        executive->status = status_create(task);
        int error = start_threads(executive, priority, &guarding);
        if (error) {
            end(result, ENDING_FAILED, NULL, strerror(error));
            make_outputs_safe(task);
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
    result->safe = safety_outcome(task, result->outputs, sizeof result->outputs);
    safety_end();
    schedule_report(executive->schedule, task);
    schedule_destroy(executive->schedule);
    status_destroy(executive->status);
    sampler_destroy(executive->watch);
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
    fprintf(out, ", \"overruns\": %" PRIu64 ", \"skipped\": %" PRIu64 ", \"timeouts\": %" PRIu64 ", \"last_overrun\": ",
            result->overruns, result->skipped, result->timeouts);
    const struct overrun_of_step *last = &result->last_overrun;
    if (result->overruns)
        fprintf(out, "{\"step\": %" PRIu64 ", \"at_ns\": %" PRId64 ", \"late_ns\": %" PRId64 "}", last->step,
                last->at_ns, last->late_ns);
    else
        fputs("null", out);
    fprintf(out, ",\n \"jitter\": ");
    statistics_write(&result->jitter, out);
    fprintf(out, ",\n \"step\": ");
    statistics_write(&result->step, out);
    fprintf(out, ",\n \"blocks\": {");
    for (size_t i = 0; i < task->count; i++) {
        const struct task_block *task_block = &task->blocks[i];
        fprintf(out, "%s\n  \"%s\": {\"count\": %" PRIu64 ", \"mean_ns\": %" PRId64 ", \"max_ns\": %" PRId64,
                i ? "," : "", task_block->block->name, task_block->timing.count, task_block->timing.mean_ns,
                task_block->timing.max_ns);
        rates_write(task_block->block, out);
        fprintf(out, "}");
    }
    fprintf(out, "}}\n");
}
