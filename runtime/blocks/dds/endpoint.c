#include "endpoint.h"

#include <math.h>
#include <pthread.h>
#include <string.h>

/* --- participants --- */

/* A participant costs a port, discovery packets to every peer, and threads: one for each domain of a program, however
 * many blocks. It belongs to the process as its sockets do, so this is no state of a block. */
enum { DOMAINS = 8 };
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static struct {
    uint32_t domain;
    unsigned users;
    dds_entity_t participant;
} participants[DOMAINS];

/* Get the participant, which the first caller creates; negative: a DDS error. Release it after success. */
static dds_entity_t have_participant(uint32_t domain)
{
    dds_entity_t result = DDS_RETCODE_OUT_OF_RESOURCES;
    int slot = -1;
    pthread_mutex_lock(&lock);
    for (int i = 0; i < DOMAINS; i++)
        if (participants[i].users ? participants[i].domain == domain : slot < 0)
            slot = i;
    if (slot >= 0 && !participants[slot].users)
        participants[slot].participant = dds_create_participant(domain, NULL, NULL);
    if (slot >= 0 && (result = participants[slot].participant) >= 0) {
        participants[slot].domain = domain;
        participants[slot].users++;
    }
    pthread_mutex_unlock(&lock);
    return result;
}

static void release_participant(uint32_t domain)
{
    pthread_mutex_lock(&lock);
    for (int i = 0; i < DOMAINS; i++)
        if (participants[i].users && participants[i].domain == domain && --participants[i].users == 0)
            dds_delete(participants[i].participant);
    pthread_mutex_unlock(&lock);
}

/* --- endpoints --- */

enum { RETRY_MS = 1000 };

static dds_qos_t *qualities_of(const struct dds_topic *topic)
{
    dds_qos_t *qualities = dds_create_qos();
    dds_qset_history(qualities, DDS_HISTORY_KEEP_LAST, 1); /* control needs the newest sample only */
    dds_qset_reliability(qualities, topic->reliable ? DDS_RELIABILITY_RELIABLE : DDS_RELIABILITY_BEST_EFFORT,
                         DDS_MSECS(100));
    if (topic->deadline > 0)
        dds_qset_deadline(qualities, llround(topic->deadline * 1e9));
    if (topic->reliable && topic->lifespan > 0) /* best effort keeps nothing that could be sent again */
        dds_qset_lifespan(qualities, llround(topic->lifespan * 1e9));
    if (topic->user_data)
        dds_qset_userdata(qualities, topic->user_data, strlen(topic->user_data));
    if (topic->partition_count) {
        const char *names[FL_SENDERS];
        for (uint32_t i = 0; i < topic->partition_count; i++)
            names[i] = topic->partitions[i];
        dds_qset_partition(qualities, topic->partition_count, names);
    }
    return qualities;
}

/* Serve until the thread has to return: true; false when DDS is not available now. */
static bool serve(const struct dds_endpoint *endpoint, const struct dds_topic *topic, struct fl_block *block,
                  struct fl_driver *driver, void *context, dds_entity_t participant)
{
    dds_listener_t *listener = dds_create_listener(context);
    dds_qos_t *qualities = qualities_of(topic);
    endpoint->set_listener(listener);
    dds_entity_t described = dds_create_topic(participant, topic->type, topic->name, NULL, NULL);
    dds_entity_t entity = described < 0 ? described : endpoint->create(participant, described, qualities, listener);
    dds_delete_qos(qualities);
    dds_delete_listener(listener);
    if (entity < 0) {
        fl_log(block, "topic %s: %s", topic->name, dds_strretcode(entity));
    } else {
        endpoint->serve(context, driver, entity);
        dds_delete(entity); /* waits for a listener that is being called */
    }
    if (described >= 0)
        dds_delete(described);
    return entity >= 0;
}

void dds_run(const struct dds_endpoint *endpoint, const struct dds_topic *topic, struct fl_block *block,
             struct fl_driver *driver, void *context)
{
    do {
        dds_entity_t participant = have_participant(topic->domain);
        if (participant < 0) {
            fl_log(block, "DDS domain %u: %s", (unsigned)topic->domain, dds_strretcode(participant));
            continue;
        }
        bool done = serve(endpoint, topic, block, driver, context, participant);
        release_participant(topic->domain);
        if (done)
            return;
    } while (fl_driver_wait(driver, -1, false, RETRY_MS) == 0);
}
