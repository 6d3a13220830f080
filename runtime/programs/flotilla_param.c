/* flotilla-param: reads and sets parameters of a running task, and asks for its state, through the socket that tuner.h
 * describes. */
#define _GNU_SOURCE
#include "task_socket.h"

#include <getopt.h>
#include <limits.h>
#include <poll.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

static const char usage[] =
    "usage: flotilla-param [OPTION]... TASK [BLOCK.PARAMETER [VALUE]]\n"
    "List the parameters of a task that runs here, or of an app's, print one of them, or set it between two steps.\n"
    "\n"
    "  --confirm OLD   set a limit of safety, which is OLD now; without this it is refused with both values\n"
    "  --status[=json] how the task does instead: steps, overruns, flags and ages of its sensors\n"
    "  --control PATH  the task's socket (default: control in /run/flotilla/TASK or\n"
    "                  /run/flotilla-apps/TASK, whichever is there)\n"
    "  --help, --version\n"
    "\n"
    "Status: 0 done, 1 refused, or no such task runs, 2 the command line is wrong.\n";

enum { ANSWER_MS = 30 * 1000 };
enum { CONTROL = 1, CONFIRM, STATUS, HELP, VERSION };

static const struct option options[] = {
    {"control", required_argument, NULL, CONTROL}, {"confirm", required_argument, NULL, CONFIRM},
    {"status", optional_argument, NULL, STATUS},   {"help", no_argument, NULL, HELP},
    {"version", no_argument, NULL, VERSION},       {0},
};

/* Read until the other end closes; NULL on time-out. To be freed. */
static char *answer_of(int fd)
{
    char *text = NULL, piece[4096];
    size_t length = 0;
    ssize_t got = 0;
    FILE *answer = open_memstream(&text, &length);
    struct pollfd waiting = {.fd = fd, .events = POLLIN};
    if (!answer)
        return NULL;
    while (poll(&waiting, 1, ANSWER_MS) == 1 && (got = recv(fd, piece, sizeof piece, 0)) > 0)
        fwrite(piece, 1, (size_t)got, answer);
    if (fclose(answer) == 0 && waiting.revents && got == 0)
        return text;
    free(text);
    return NULL;
}

/* Make one request; returns the exit status. */
static int ask(const char *task, const char *path, const char *request, size_t length)
{
    int fd = task_socket_connect(task, path), status = 1;
    if (fd < 0)
        return 1;
    char *answer = send(fd, request, length, MSG_NOSIGNAL) == (ssize_t)length ? answer_of(fd) : NULL;
    close(fd);
    char *said = answer ? strchr(answer, '\n') : NULL;
    if (!said) {
        fprintf(stderr, "flotilla-param: task %s does not answer\n", task);
    } else if (strncmp(answer, "ok\n", 3) == 0) {
        fputs(said + 1, stdout);
        status = fflush(stdout) == 0 ? 0 : 1;
    } else {
        fprintf(stderr, "flotilla-param: task %s: %s", task, said + 1);
    }
    free(answer);
    return status;
}

/* The request as tuner.h has it; false when a word would break its line. */
static bool write_request(char **request, size_t *length, const char *verb, const char *old, char **words, int count)
{
    FILE *out = open_memstream(request, length);
    if (!out)
        abort();
    fputs(verb, out);
    for (int i = 0; i < count; i++)
        fprintf(out, "%s%s %s", i == 1 && old ? " " : "", i == 1 && old ? old : "", words[i]);
    bool good = (!old || (count == 2 && !strpbrk(old, " \n"))) && (count == 0 || !strpbrk(words[0], " \n")) &&
                (count < 2 || !strchr(words[1], '\n'));
    fputc('\n', out);
    return fclose(out) == 0 && good;
}

int main(int argc, char **argv)
{
    static const char *const verbs[] = {"list", "get", "set"}; /* by the number of words */
    const char *path = NULL, *status = NULL, *old = NULL;
    char usual[PATH_MAX], *request;
    size_t length;
    for (int option; (option = getopt_long(argc, argv, "+", options, NULL)) != -1;) { /* a value may begin with - */
        switch (option) {
        case CONTROL:
            path = optarg;
            break;
        case CONFIRM:
            old = optarg;
            break;
        case STATUS:
            status = !optarg ? "status" : strcmp(optarg, "json") == 0 ? "status json" : NULL;
            if (status)
                break;
            fprintf(stderr, "flotilla-param: --status=%s: there is --status and --status=json\n", optarg);
            return 2;
        case HELP:
            fputs(usage, stdout);
            return 0;
        case VERSION:
            puts("flotilla-param " FLOTILLA_VERSION);
            return 0;
        default:
            fputs(usage, stderr);
            return 2;
        }
    }
    int words = argc - optind;
    if (words < 1 || words > (status ? 1 : 3) || strchr(argv[optind], '/') ||
        !write_request(&request, &length,
                       status ? status
                       : old  ? "confirm"
                              : verbs[words - 1],
                       old, argv + optind + 1, words - 1)) {
        fputs(usage, stderr);
        return 2;
    }
    if (!path && !task_socket_find(argv[optind], usual, sizeof usual))
        return 1;
    int done = ask(argv[optind], path ? path : usual, request, length);
    free(request);
    return done;
}
