#define _GNU_SOURCE
#include "receiver.h"

#include <errno.h>
#include <math.h>
#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

enum { BATCH = 8 };

/* What DDS's thread hands over. */
struct arrival {
    uint32_t sequence;
    _Alignas(8) unsigned char sample[]; /* begins with when it arrived */
};

static void matched(dds_entity_t reader, const dds_subscription_matched_status_t status, void *context)
{
    struct dds_receiver *receiver = context;
    (void)reader;
    atomic_store(&receiver->peers, status.current_count);
}

/* Called by DDS, one call at a time for a reader. */
static void arrived(dds_entity_t reader, void *context)
{
    struct dds_receiver *receiver = context;
    void *samples[BATCH] = {NULL};
    dds_sample_info_t infos[BATCH];
    dds_return_t count;
    while ((count = dds_take(reader, samples, infos, BATCH, BATCH)) > 0) {
        int64_t now_ns = fl_now_ns();
        for (dds_return_t i = 0; i < count; i++) {
            struct arrival *arrival = newest_back(&receiver->samples);
            *(int64_t *)(void *)arrival->sample = now_ns;
            receiver->reader = reader;
            receiver->writer = infos[i].publication_handle;
            if (!infos[i].valid_data || !receiver->decode(receiver->block, samples[i], arrival->sample))
                continue;
            arrival->sequence = ++receiver->arrived;
            newest_put(&receiver->samples);
            eventfd_write(receiver->arrived_fd, 1);
        }
        dds_return_loan(reader, samples, count);
        samples[0] = NULL;
    }
}

static void set_listener(dds_listener_t *listener)
{
    dds_lset_data_available(listener, arrived);
    dds_lset_subscription_matched(listener, matched);
}

/* DDS's own thread calls the listener. */
static void serve(void *context, struct fl_driver *driver, dds_entity_t reader)
{
    (void)context;
    (void)reader;
    fl_driver_wait(driver, -1, false, -1);
}

static void run(struct fl_driver *driver, void *context)
{
    static const struct dds_endpoint endpoint = {dds_create_reader, set_listener, serve};
    struct dds_receiver *receiver = context;
    dds_run(&endpoint, &receiver->topic, receiver->block, driver, receiver);
}

int dds_receiver_start(struct dds_receiver *receiver, struct fl_block *block)
{
    receiver->block = block;
    if (newest_allocate(&receiver->samples, block, sizeof(struct arrival) + receiver->sample_bytes) != FL_OK)
        return FL_FAILED;
    fl_sensor_begin(&receiver->sensor);
    receiver->arrived_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    if (receiver->arrived_fd < 0)
        return fl_fail(block, "eventfd: %s", strerror(errno));
    receiver->open = true;
    receiver->driver = fl_driver_start(block, run, receiver);
    return receiver->driver ? FL_OK : FL_FAILED;
}

/* Take the newest sample that waits. When it arrived; 0: none did. */
static int64_t take(struct dds_receiver *receiver)
{
    const struct arrival *arrival = newest_take(&receiver->samples);
    if (!arrival)
        return 0;
    int64_t arrived_ns = *(const int64_t *)(const void *)arrival->sample;
    fl_sensor_update(&receiver->sensor, arrived_ns, arrival->sequence);
    receiver->give(receiver->block, arrival->sample);
    return arrived_ns;
}

/* Take the sample here instead of in the step: the step could find a newer one than the sample that triggered it. */
int64_t dds_receiver_await(struct dds_receiver *receiver, int64_t until_ns)
{
    int64_t taken_ns;
    receiver->awaited = true;
    do {
        eventfd_t count;
        eventfd_read(receiver->arrived_fd, &count); /* before the look at the sample: later ones are not missed */
        taken_ns = take(receiver);
    } while (!taken_ns && fl_await_readable(receiver->arrived_fd, until_ns));
    return taken_ns ? taken_ns : take(receiver); /* a sample may have come while this thread woke up */
}

void dds_receiver_step(struct dds_receiver *receiver, uint32_t peers, uint32_t flag, double timeout)
{
    if (!receiver->awaited)
        take(receiver);
    FL_OUT(receiver->block, peers, uint32_t) = atomic_load(&receiver->peers);
    /* Go by the age of the sample: the status of DDS covers all that publish the topic. */
    const double deadline = receiver->topic.deadline;
    fl_sensor_outputs(&receiver->sensor, receiver->block, flag, true, deadline > 0 ? fmin(deadline, timeout) : timeout);
}

void dds_receiver_stop(struct dds_receiver *receiver)
{
    fl_driver_stop(receiver->driver);
    if (receiver->open)
        close(receiver->arrived_fd);
}
