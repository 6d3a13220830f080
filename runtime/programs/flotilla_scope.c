/* flotilla-scope: prints signals of a running task, step by step, through the socket that executive/tuner.h describes.
 */
#define _GNU_SOURCE
#include "task_socket.h"

#include <getopt.h>
#include <inttypes.h>
#include <limits.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

static const char usage[] =
    "usage: flotilla-scope [OPTION]... TASK [SIGNAL]...\n"
    "Print signals (block.port, block.port[2]) of a task or an app that runs here, a line for each step; without one,\n"
    "list what there is: name, type, number of elements, unit. The task does not wait for this program.\n"
    "\n"
    "  --every N           only steps whose number is a multiple of N\n"
    "  --rows N            end after N lines (default: when interrupted; 1000 with a trigger)\n"
    "  --trigger CROSSING  wait until a signal crosses a value: 'SIGNAL>VALUE' upwards, 'SIGNAL<VALUE' downwards\n"
    "  --before N          of the lines, so many are of the steps before that\n"
    "  --csv               a table instead of lines of JSON\n"
    "  --control PATH      the task's socket (default: control in /run/flotilla/TASK or\n"
    "                      /run/flotilla-apps/TASK, whichever is there)\n"
    "  --help, --version\n"
    "\n"
    "Status: 0 done, 1 refused, no such task runs, or it has ended, 2 the command line is wrong.\n";

enum { EVERY = 1, ROWS, TRIGGER, BEFORE, CSV, CONTROL, HELP, VERSION };

static const struct option options[] = {
    {"every", required_argument, NULL, EVERY},
    {"rows", required_argument, NULL, ROWS},
    {"trigger", required_argument, NULL, TRIGGER},
    {"before", required_argument, NULL, BEFORE},
    {"csv", no_argument, NULL, CSV},
    {"control", required_argument, NULL, CONTROL},
    {"help", no_argument, NULL, HELP},
    {"version", no_argument, NULL, VERSION},
    {0},
};
static const char *const keys[] = {[EVERY] = "every", [ROWS] = "rows", [TRIGGER] = "trigger", [BEFORE] = "before"};

/* Add a word to the request; false when it would be two. */
static bool add_word(FILE *request, const char *key, const char *value)
{
    fprintf(request, " %s%s%s", key ? key : "", key ? "=" : "", value);
    return *value && !strpbrk(value, " \n");
}

/* Copy what comes to stdout until the other end closes. Returns the exit status. */
static int copy(FILE *from, const char *task, bool endless)
{
    char *line = NULL;
    size_t size = 0;
    bool good = getline(&line, &size, from) > 0, refused = good && strcmp(line, "error\n") == 0;
    if (!good || refused)
        fprintf(stderr, "flotilla-scope: task %s%s", task, refused ? ": " : " does not answer\n");
    FILE *to = refused ? stderr : stdout;
    for (ssize_t got; good && (got = getline(&line, &size, from)) > 0;) {
        fwrite(line, 1, (size_t)got, to);
        good = fflush(to) == 0;
    }
    free(line);
    if (good && !refused && endless)
        fprintf(stderr, "flotilla-scope: task %s has ended\n", task);
    return !good || refused || endless;
}

static int ask(const char *task, const char *path, const char *request, size_t length, bool endless)
{
    int fd = task_socket_connect(task, path), status = 1;
    if (fd < 0)
        return 1;
    FILE *answer = fdopen(fd, "r");
    if (!answer)
        abort();
    if (send(fd, request, length, MSG_NOSIGNAL) == (ssize_t)length)
        status = copy(answer, task, endless);
    else
        fprintf(stderr, "flotilla-scope: task %s does not listen\n", task);
    fclose(answer);
    return status;
}

int main(int argc, char **argv)
{
    const char *path = NULL;
    char usual[PATH_MAX], *words = NULL, *request = NULL;
    size_t length;
    bool good = true, endless = true;
    FILE *out = open_memstream(&words, &length);
    if (!out)
        abort();
    for (int option; (option = getopt_long(argc, argv, "", options, NULL)) != -1;) {
        switch (option) {
        case ROWS:
        case TRIGGER:
            endless = false;
            __attribute__((fallthrough));
        case EVERY:
        case BEFORE:
            good &= add_word(out, keys[option], optarg);
            break;
        case CSV:
            good &= add_word(out, NULL, "csv");
            break;
        case CONTROL:
            path = optarg;
            break;
        case HELP:
            fputs(usage, stdout);
            return 0;
        case VERSION:
            puts("flotilla-scope " FLOTILLA_VERSION);
            return 0;
        default:
            good = false;
        }
    }
    const char *task = argv[optind];
    bool listing = argc - optind == 1;
    for (int i = optind + 1; i < argc; i++)
        good &= add_word(out, NULL, argv[i]) && !strchr(argv[i], '=');
    if (fclose(out) != 0 || asprintf(&request, "%s%s\n", listing ? "signals" : "watch", words) < 0)
        abort();
    free(words);
    int status = 2;
    if (!good || !task || strchr(task, '/') || (listing && length))
        fputs(usage, stderr);
    else if (!path && !task_socket_find(task, usual, sizeof usual))
        status = 1;
    else
        status = ask(task, path ? path : usual, request, strlen(request), !listing && endless);
    free(request);
    return status;
}
