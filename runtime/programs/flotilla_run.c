/* flotilla-run: runs the task of a file, or reports what is wrong with it. */
#define _GNU_SOURCE
#include "core/service.h"
#include "executive/executive.h"
#include "executive/instance.h"
#include "executive/safety.h"
#include "executive/tuner.h"

#include <errno.h>
#include <getopt.h>
#include <inttypes.h>
#include <limits.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>

static const char usage[] =
    "usage: flotilla-run [OPTION]... TASK.yml\n"
    "       flotilla-run --keys\n"
    "Run the control task that TASK.yml describes, until SIGTERM or SIGINT.\n"
    "\n"
    "  --check             only say what is wrong with the task; opens no device\n"
    "  --dot               write the task as a graph for Graphviz\n"
    "  --safe              only bring all outputs to their reset state\n"
    "  --steps N           end after N steps\n"
    "  --no-wait           do not wait for releases: time is counted, not measured\n"
    "  --watch SIGNALS     print block.port,block.port[2],... each step, a line of JSON each\n"
    "  --statistics FILE   write times, jitter and overruns as JSON at the end\n"
    "  --control PATH      socket for flotilla-param: parameters, how the task does\n"
    "                      (default: control in $RUNTIME_DIRECTORY, as a service has one; otherwise none)\n"
    "  --blocks DIRECTORY  plug-ins with further blocks (default: " FLOTILLA_BLOCKS "); several are separated by ':'\n"
    "  --keys              list the keys of task files, as JSON\n"
    "  --help, --version\n"
    "\n"
    "Status: 0 ended as asked, 1 the task failed, 2 the command line or the task file is wrong, 3 it runs already,\n"
    "4 outputs may not be in their reset state, however the task ended.\n";

enum { CHECK = 1, DOT, SAFE, STEPS, NO_WAIT, WATCH, STATISTICS, CONTROL, BLOCKS, KEYS, HELP, VERSION };

static const struct option options[] = {
    {"check", no_argument, NULL, CHECK},
    {"dot", no_argument, NULL, DOT},
    {"safe", no_argument, NULL, SAFE},
    {"steps", required_argument, NULL, STEPS},
    {"no-wait", no_argument, NULL, NO_WAIT},
    {"watch", required_argument, NULL, WATCH},
    {"blocks", required_argument, NULL, BLOCKS},
    {"control", required_argument, NULL, CONTROL},
    {"statistics", required_argument, NULL, STATISTICS},
    {"keys", no_argument, NULL, KEYS},
    {"help", no_argument, NULL, HELP},
    {"version", no_argument, NULL, VERSION},
    {0},
};

struct command {
    int mode; /* CHECK, DOT, SAFE, or 0: run */
    const char *path, *blocks, *statistics, *control;
    char *watch;
    struct run_options run;
};

static bool parse(struct command *command, int argc, char **argv)
{
    int64_t steps = 0;
    for (int option; (option = getopt_long(argc, argv, "", options, NULL)) != -1;) {
        switch (option) {
        case CHECK:
        case DOT:
        case SAFE:
            command->mode = option;
            break;
        case STEPS:
            if (!read_integer(optarg, &steps) || steps < 1) {
                fprintf(stderr, "flotilla-run: --steps %s: not a whole number from 1\n", optarg);
                return false;
            }
            command->run.steps = (uint64_t)steps;
            break;
        case NO_WAIT:
            command->run.no_wait = true;
            break;
        case WATCH:
            command->watch = optarg;
            break;
        case STATISTICS:
            command->statistics = optarg;
            break;
        case CONTROL:
            command->control = optarg;
            break;
        case BLOCKS:
            command->blocks = optarg;
            break;
        case KEYS:
            task_file_write_keys(stdout);
            exit(0);
        case HELP:
            fputs(usage, stdout);
            exit(0);
        case VERSION:
            printf("flotilla-run " FLOTILLA_VERSION ", interface %u of blocks\n", FL_ABI);
            exit(0);
        default:
            fputs(usage, stderr);
            return false;
        }
    }
    if (optind != argc - 1) {
        fputs(usage, stderr);
        return false;
    }
    command->path = argv[optind];
    return true;
}

/* The signals to print; false when one does not exist. */
static bool find_watched(struct command *command, const struct task *task)
{
    char reason[256];
    struct watched *watched = calloc(strlen(command->watch) + 1, sizeof *watched);
    size_t count = 0;
    if (!watched)
        abort();
    for (char *rest = command->watch, *name; (name = strsep(&rest, ","));) {
        struct watched *each = &watched[count++];
        each->name = name;
        each->signal = task_signal(task, name, &each->type, &each->width, reason, sizeof reason);
        if (!each->signal) {
            fprintf(stderr, "%sflotilla-run: --watch %s\n", fl_priority(FL_ERROR), reason);
            free(watched);
            return false;
        }
    }
    command->run.watched = watched;
    command->run.watched_count = count;
    return true;
}

static bool write_statistics(const char *path, const struct task *task, const struct run_result *result)
{
    FILE *out = fopen(path, "we");
    if (out)
        executive_write_statistics(task, result, out);
    if (!out || fclose(out) != 0) {
        fprintf(stderr, "%sflotilla-run: --statistics %s: %s\n", fl_priority(FL_ERROR), path, strerror(errno));
        return false;
    }
    return true;
}

/* False when the user asked for the socket and it cannot be made. A service controls its robot without it. */
static bool open_control(struct command *command, struct task *task)
{
    char path[PATH_MAX];
    const char *directory = getenv("RUNTIME_DIRECTORY");
    if (!command->control && !directory)
        return true;
    snprintf(path, sizeof path, "%s/control", directory ? directory : "");
    command->run.tuner = tuner_create(command->control ? command->control : path, task);
    return command->run.tuner || !command->control;
}

static int run(struct command *command, struct task *task)
{
    struct run_result result;
    int holder = instance_lock(command->path);
    if (holder > 0)
        fprintf(stderr, "%sflotilla-run: %s runs already, as process %d; end that first\n", fl_priority(FL_ERROR),
                command->path, holder);
    else if (holder < 0)
        fprintf(stderr, "%sflotilla-run: %s: %s\n", fl_priority(FL_ERROR), command->path, strerror(errno));
    if (holder)
        return 3;
    if (!open_control(command, task))
        return 2;
    command->run.service = getenv("RUNTIME_DIRECTORY") != NULL;
    executive_run(task, &command->run, &result);
    tuner_destroy(command->run.tuner);
    bool written = !command->statistics || write_statistics(command->statistics, task, &result);
    if (result.ending != ENDING_ASKED || !result.safe)
        fprintf(stderr, "%sflotilla: %s: %s; %s\n",
                fl_priority(result.safe && result.ending == ENDING_DONE ? FL_INFO : FL_ERROR), task->name,
                result.reason, result.outputs);
    if (!result.safe)
        return SAFETY_UNKNOWN;
    return (result.ending == ENDING_ASKED || result.ending == ENDING_DONE) && written ? 0 : 1;
}

int main(int argc, char **argv)
{
    struct command command = {.blocks = FLOTILLA_BLOCKS};
    struct registry registry = {0};
    struct task task;
    int status = 0;
    fl_priority_begin();
    signal(SIGPIPE, SIG_IGN); /* a reader that has gone must not end a control task */
    if (!parse(&command, argc, argv))
        return 2;
    struct problems problems = {.file = command.path, .out = stderr};
    registry_fill(&registry, command.blocks, stderr);
    task_build(&task, &registry, &problems);
    if (problems.count || (command.watch && !find_watched(&command, &task)))
        status = 2;
    else if (command.mode == DOT)
        task_write_dot(&task, stdout);
    else if (command.mode == SAFE)
        status = executive_make_safe(&task) ? 0 : SAFETY_UNKNOWN;
    else if (command.mode != CHECK)
        status = run(&command, &task);
    free((void *)(uintptr_t)command.run.watched);
    task_free(&task);
    registry_clear(&registry);
    return status;
}
