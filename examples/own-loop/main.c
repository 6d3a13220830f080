/* own-loop: a loop in real time. On SIGTERM it ends and writes how well it kept its period. */
#include <inttypes.h>
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>

enum { PERIOD_NS = 10000000, PRIORITY = 64, SECOND_NS = 1000000000, BINS = 10000 };

/* Times, counted in bins of 1 µs; the last one holds all that are longer. */
struct times {
    uint64_t count, bins[BINS];
    int64_t min_ns, max_ns, sum_ns;
};

static volatile sig_atomic_t asked_to_end;

static void end(int signal)
{
    (void)signal;
    asked_to_end = 1;
}

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * SECOND_NS + now.tv_nsec;
}

static void add(struct times *times, int64_t ns)
{
    times->bins[ns / 1000 < BINS ? ns / 1000 : BINS - 1]++;
    times->min_ns = !times->count || ns < times->min_ns ? ns : times->min_ns;
    times->max_ns = ns > times->max_ns ? ns : times->max_ns;
    times->sum_ns += ns;
    times->count++;
}

static void write_times(const struct times *times, FILE *out)
{
    uint64_t sum = 0;
    int64_t bin = 0, mean_ns = times->count ? times->sum_ns / (int64_t)times->count : 0;
    while (bin < BINS - 1 && (sum += times->bins[bin]) * 100 < times->count * 99)
        bin++;
    int64_t p99_ns = (bin + 1) * 1000 < times->max_ns ? (bin + 1) * 1000 : times->max_ns;
    fprintf(out, "{\"count\": %" PRIu64 ", \"min_ns\": %" PRId64 ", \"mean_ns\": %" PRId64, times->count, times->min_ns,
            mean_ns);
    fprintf(out, ", \"max_ns\": %" PRId64 ", \"p99_ns\": %" PRId64 "}", times->max_ns, p99_ns);
}

static void control(void)
{
    /* What the robot is to do in each period. */
}

int main(void)
{
    static struct times jitter, step;
    uint64_t overruns = 0, skipped = 0;
    struct sched_param priority = {.sched_priority = PRIORITY};
    struct sigaction action = {.sa_handler = end};
    sigaction(SIGTERM, &action, NULL);
    sigaction(SIGINT, &action, NULL);
    if (mlockall(MCL_CURRENT | MCL_FUTURE) || sched_setscheduler(0, SCHED_FIFO, &priority))
        perror("own-loop: no real time");
    printf("own-loop: runs\n");
    fflush(stdout);

    int64_t due_ns = now_ns() + PERIOD_NS;
    while (!asked_to_end) {
        struct timespec due = {.tv_sec = due_ns / SECOND_NS, .tv_nsec = due_ns % SECOND_NS};
        if (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL))
            continue; /* a signal */
        int64_t woken_ns = now_ns();
        control();
        int64_t done_ns = now_ns();
        add(&jitter, woken_ns - due_ns);
        add(&step, done_ns - woken_ns);
        due_ns += PERIOD_NS;
        if (done_ns > due_ns) { /* too late for the next one: leave it out, and those after it */
            int64_t missed = (done_ns - due_ns) / PERIOD_NS + 1;
            overruns++;
            skipped += (uint64_t)missed;
            due_ns += missed * PERIOD_NS;
        }
    }

    const char *directory = getenv("STATE_DIRECTORY"); /* the service's; make deploy reports what is written there */
    if (directory) {
        char path[256];
        snprintf(path, sizeof path, "%s/statistics.json", directory);
        FILE *out = fopen(path, "w");
        if (!out) {
            perror(path);
            return 1;
        }
        fprintf(out, "{\"task\": \"own-loop\", \"period_ns\": %d, \"steps\": %" PRIu64, PERIOD_NS, step.count);
        fprintf(out, ", \"overruns\": %" PRIu64 ", \"skipped\": %" PRIu64 ", \"jitter\": ", overruns, skipped);
        write_times(&jitter, out);
        fprintf(out, ", \"step\": ");
        write_times(&step, out);
        fprintf(out, "}\n");
        if (fclose(out)) {
            perror(path);
            return 1;
        }
    }
    return 0;
}
