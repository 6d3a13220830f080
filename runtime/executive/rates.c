#define _GNU_SOURCE
#include "rates.h"

#include "core/service.h"
#include "privilege.h"
#include "safety.h"

#include <errno.h>
#include <inttypes.h>
#include <pthread.h>
#include <sched.h>
#include <semaphore.h>
#include <stdatomic.h>
#include <string.h>
#include <time.h>

enum {
    HUNG_PERIODS = 10, /* periods of the rate, plus 1 s, after which a run counts as hung */
    JOIN_S = 1,        /* at the end of the task; the service manager waits for two */
};

#define SECOND_NS INT64_C(1000000000)

/* A rate. Its thread has what is between two releases, the thread of the step everything else. */
struct rate {
    const struct fl_rate *rate;
    struct fl_block *block;
    pthread_t thread;
    sem_t released, ended, left; /* `left`: the thread does nothing more */
    _Atomic bool running, stop;
    bool started;        /* the thread */
    bool due;            /* in this step, and not running */
    int64_t released_ns; /* when it was last */
    int64_t in_a_row;    /* overruns */
    uint64_t overruns;
    uint64_t count; /* of runs; the thread's */
    int64_t sum_ns, max_ns;
};

struct fl_rates {
    uint32_t count;
    struct rate each[];
};

static void wait_for(sem_t *semaphore)
{
    while (sem_wait(semaphore) < 0)
        continue; /* interrupted */
}

static void *serve(void *argument)
{
    struct rate *rate = argument;
    safety_running = rate->block;
    privilege_touch_stack();
    for (;;) {
        wait_for(&rate->released);
        if (atomic_load_explicit(&rate->stop, memory_order_acquire)) {
            sem_post(&rate->left);
            return NULL;
        }
        int64_t begin_ns = fl_now_ns();
        rate->rate->run(rate->block);
        int64_t took_ns = fl_now_ns() - begin_ns;
        rate->count++;
        rate->sum_ns += took_ns;
        rate->max_ns = took_ns > rate->max_ns ? took_ns : rate->max_ns;
        atomic_store_explicit(&rate->running, false, memory_order_release);
        if (rate->block->service->rates_in_turn)
            sem_post(&rate->ended);
    }
}

static bool runs(const struct rate *rate)
{
    return atomic_load_explicit(&rate->running, memory_order_acquire);
}

int rates_priority(int drivers, uint32_t place)
{
    const int first = drivers < RATES_BELOW ? drivers - 1 : RATES_BELOW - 1;
    if (!drivers)
        return 0;
    return place < (uint32_t)first ? first - (int)place : -1;
}

int fl_rates_start(struct fl_block *block, const struct fl_rate *rates, uint32_t count)
{
    const int below = block->service->priority; /* that of drivers */
    struct fl_rates *made = fl_allocate(block, sizeof *made + count * sizeof made->each[0]);
    if (!made)
        return FL_FAILED;
    made->count = count;
    if (rates_priority(below, count - 1) < 0)
        return fl_fail(block, "%u slower rates need a priority each below the task's, which is %d; give it %u or more",
                       (unsigned)count, below + 1, (unsigned)count + 2);
    block->service->rates = made;
    for (uint32_t i = 0; i < count; i++) {
        struct rate *rate = &made->each[i];
        struct fl_service service = {.priority = rates_priority(below, i)};
        rate->rate = &rates[i];
        rate->block = block;
        sem_init(&rate->released, 0, 0);
        sem_init(&rate->ended, 0, 0);
        sem_init(&rate->left, 0, 0);
        int error = fl_service_thread(&service, &rate->thread, rates[i].name, serve, rate);
        if (error)
            return fl_fail(block, "cannot start the thread of %s: %s", rates[i].name, strerror(error));
        rate->started = true;
    }
    return FL_OK;
}

/* End the process because a run does not end. */
static _Noreturn void abandon(const struct rate *rate, const char *where, int64_t since_ns)
{
    char text[FL_FAILURE_BYTES];
    snprintf(text, sizeof text, "flotilla: %s: %s %s, %.3f s after its release; ", rate->block->name, rate->rate->name,
             where, (double)since_ns / 1e9);
    safety_abandon(text);
}

/* At a release of a rate that runs. */
static int overrun(struct rate *rate)
{
    struct fl_block *block = rate->block;
    struct fl_service *service = block->service;
    const int64_t since_ns = fl_now_ns() - rate->released_ns;
    const int64_t period_ns = block->period_ns * (int64_t)rate->rate->every;
    if (since_ns > HUNG_PERIODS * period_ns + SECOND_NS)
        abandon(rate, "hangs", since_ns);
    rate->overruns++;
    rate->in_a_row++;
    if (service->overran)
        service->overran(service->overran_context, since_ns - period_ns);
    if (!service->overruns || rate->in_a_row < service->overruns)
        return FL_OK;
    service->overrun_ends = true;
    return fl_fail(block, "%s still ran when it was due again, %" PRId64 " times in a row", rate->rate->name,
                   rate->in_a_row);
}

int fl_rates_begin(struct fl_block *block)
{
    struct fl_rates *rates = block->service->rates;
    int result = FL_OK;
    for (uint32_t i = 0; i < rates->count; i++) {
        struct rate *rate = &rates->each[i];
        rate->due = false;
        if (block->step % rate->rate->every != 0)
            continue;
        if (runs(rate)) {
            if (overrun(rate) != FL_OK)
                result = FL_FAILED;
            continue;
        }
        rate->due = true;
        rate->in_a_row = 0;
        if (block->step && rate->rate->publish)
            rate->rate->publish(block);
        if (rate->rate->latch)
            rate->rate->latch(block);
    }
    return result;
}

bool fl_rates_aligned(const struct fl_block *block)
{
    const struct fl_rates *rates = block->service->rates;
    for (uint32_t i = 0; i < rates->count; i++)
        if (!rates->each[i].due)
            return false;
    return true;
}

void fl_rates_release(struct fl_block *block)
{
    struct fl_rates *rates = block->service->rates;
    for (uint32_t i = 0; i < rates->count; i++) {
        struct rate *rate = &rates->each[i];
        if (!rate->due)
            continue;
        rate->released_ns = block->release_ns;
        atomic_store_explicit(&rate->running, true, memory_order_release);
        sem_post(&rate->released);
        if (block->service->rates_in_turn)
            wait_for(&rate->ended);
    }
}

void fl_rates_stop(struct fl_block *block)
{
    struct fl_rates *rates = block->service->rates;
    const int64_t until_ns = fl_now_ns() + JOIN_S * SECOND_NS;
    const struct timespec until = {(time_t)(until_ns / SECOND_NS), (long)(until_ns % SECOND_NS)};
    for (uint32_t i = 0; rates && i < rates->count; i++) {
        atomic_store_explicit(&rates->each[i].stop, true, memory_order_release);
        if (rates->each[i].started)
            sem_post(&rates->each[i].released);
    }
    for (uint32_t i = 0; rates && i < rates->count; i++) {
        struct rate *rate = &rates->each[i];
        if (!rate->started)
            continue;
        int waited;
        while ((waited = sem_clockwait(&rate->left, CLOCK_MONOTONIC, &until)) < 0 && errno == EINTR)
            continue;
        if (waited < 0)
            abandon(rate, "did not end with the task", fl_now_ns() - rate->released_ns);
        pthread_join(rate->thread, NULL);
        rate->started = false;
        sem_destroy(&rate->left);
        sem_destroy(&rate->released);
        sem_destroy(&rate->ended);
    }
}

int rates_gather(const struct fl_block *block)
{
    const struct fl_rates *rates = block->service->rates;
    cpu_set_t here;
    int processor = sched_getcpu(), error = 0;
    if (!rates)
        return 0;
    if (processor < 0 || processor >= CPU_SETSIZE)
        return ENOSYS;
    CPU_ZERO(&here);
    CPU_SET((size_t)processor, &here);
    error = pthread_setaffinity_np(pthread_self(), sizeof here, &here);
    for (uint32_t i = 0; !error && i < rates->count; i++)
        error = pthread_setaffinity_np(rates->each[i].thread, sizeof here, &here);
    return error;
}

bool rates_run(const struct fl_block *block, uint32_t rate)
{
    return runs(&block->service->rates->each[rate]);
}

void rates_in_turn(const struct fl_block *block)
{
    block->service->rates_in_turn = true;
}

void rates_relax(const struct fl_block *block)
{
    const struct fl_rates *rates = block->service->rates;
    for (uint32_t i = 0; rates && i < rates->count; i++)
        if (rates->each[i].started)
            pthread_setschedparam(rates->each[i].thread, SCHED_OTHER, &(struct sched_param){0});
}

void rates_write(const struct fl_block *block, FILE *out)
{
    const struct fl_rates *rates = block->service->rates;
    if (!rates)
        return;
    fprintf(out, ", \"rates\": [");
    for (uint32_t i = 0; i < rates->count; i++) {
        const struct rate *rate = &rates->each[i];
        fprintf(out,
                "%s{\"name\": \"%s\", \"every\": %" PRIu64 ", \"count\": %" PRIu64 ", \"overruns\": %" PRIu64
                ", \"mean_ns\": %" PRId64 ", \"max_ns\": %" PRId64 "}",
                i ? ", " : "", rate->rate->name, rate->rate->every, rate->count, rate->overruns,
                rate->count ? rate->sum_ns / (int64_t)rate->count : 0, rate->max_ns);
    }
    fprintf(out, "]");
}
