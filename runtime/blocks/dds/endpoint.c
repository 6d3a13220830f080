#define _GNU_SOURCE
#include "endpoint.h"

#include "core/service.h"

#include <dds/ddsrt/log.h>
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* --- what Cyclone DDS logs --- */

/* Without a network Cyclone logs each message that it cannot send. A line is written once for each place in its code,
 * until that place has logged nothing for a while. */
enum { PLACES = 64 };
#define QUIET_NS (INT64_C(1000000000) * FL_REASONS_STEADY_S)

struct place {
    const char *file; /* NULL: none */
    uint32_t line;
    int64_t last_ns; /* of what it has logged, written or not */
};
static struct {
    pthread_mutex_t lock;
    struct place places[PLACES];
} logged = {.lock = PTHREAD_MUTEX_INITIALIZER};

enum { WHY_BYTES = 192 };
/* Where the first error of the calling thread goes instead; NULL: nowhere else. */
static _Thread_local char *why;

/* Whether the place has logged nothing lately. A place that is not known takes the place of the one that has been quiet
 * for longest. */
static bool is_new(const char *file, uint32_t line)
{
    const int64_t now_ns = fl_now_ns();
    pthread_mutex_lock(&logged.lock);
    struct place *place = logged.places;
    for (struct place *other = place; other < logged.places + PLACES; other++) {
        if (other->file && other->line == line && strcmp(other->file, file) == 0) {
            place = other;
            break;
        }
        if (!other->file || (place->file && other->last_ns < place->last_ns))
            place = other;
    }
    bool known = place->file && place->line == line && strcmp(place->file, file) == 0;
    bool new = !known || now_ns - place->last_ns > QUIET_NS;
    *place = (struct place){file, line, now_ns};
    pthread_mutex_unlock(&logged.lock);
    return new;
}

static void write_log(void *context, const dds_log_data_t *data)
{
    (void)context;
    const char *text = data->message;
    int length = (int)strlen(text);
    while (length && strchr(".\n", text[length - 1]))
        length--;
    if (why && data->priority & (DDS_LC_ERROR | DDS_LC_FATAL)) {
        if (!*why)
            snprintf(why, WHY_BYTES, "%.*s", length, text);
    } else if (is_new(data->file, data->line)) {
        fprintf(stderr, "%sDDS: %.*s\n",
                fl_priority(data->priority & (DDS_LC_ERROR | DDS_LC_FATAL) ? FL_ERROR
                            : data->priority & DDS_LC_WARNING              ? FL_WARNING
                                                                           : FL_INFO),
                length, text);
    }
}

/* --- participants --- */

/* A participant costs a port, discovery packets to every peer, and threads: one for each domain of a program, however
 * many blocks. It belongs to the process as its sockets do, so this is no state of a block. */
enum { DOMAINS = 8 };
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static struct domain {
    bool known;
    uint32_t number;
    unsigned users;
    bool missing;       /* why it is not available was logged */
    dds_entity_t whole; /* what the last user deletes */
    dds_entity_t participant;
} domains[DOMAINS];

/* $CYCLONEDDS_URI, and what the end of a task depends on: Cyclone wakes a thread that receives for one socket alone by
 * a datagram over the network, and waits for that thread. Without the network it waits for ever. */
static char *configuration(void)
{
    static const char one_thread[] = "<CycloneDDS><Domain Id=\"any\"><Internal>"
                                     "<MultipleReceiveThreads>false</MultipleReceiveThreads>"
                                     "</Internal></Domain></CycloneDDS>";
    const char *uri = getenv("CYCLONEDDS_URI");
    char *both = NULL;
    return asprintf(&both, "%s%s%s", uri ? uri : "", uri && *uri ? "," : "", one_thread) < 0 ? NULL : both;
}

static dds_entity_t create(struct domain *domain)
{
    char *both = configuration();
    domain->whole = both ? dds_create_domain(domain->number, both) : DDS_RETCODE_OUT_OF_RESOURCES;
    free(both);
    if (domain->whole < 0 && domain->whole != DDS_RETCODE_PRECONDITION_NOT_MET)
        return domain->whole;
    dds_entity_t participant = dds_create_participant(domain->number, NULL, NULL);
    if (domain->whole < 0) /* somebody else in this process has created the domain */
        domain->whole = participant;
    else if (participant < 0)
        dds_delete(domain->whole);
    return participant;
}

/* Log once why the domain is not available, or that it is again. */
static void log_domain(struct fl_block *block, struct domain *domain, const char *reason)
{
    bool missing = domain->participant < 0;
    if (missing == domain->missing)
        return;
    domain->missing = missing;
    if (missing)
        fl_warn(block, "DDS domain %u: %s; retrying", (unsigned)domain->number,
                *reason ? reason : dds_strretcode(domain->participant));
    else
        fl_log(block, "DDS domain %u is available", (unsigned)domain->number);
}

static struct domain *domain_numbered(uint32_t number)
{
    for (int i = 0; i < DOMAINS; i++) {
        if (!domains[i].known)
            domains[i] = (struct domain){.known = true, .number = number};
        if (domains[i].number == number)
            return &domains[i];
    }
    return NULL;
}

/* Get the participant, which the first caller creates; negative: a DDS error, which is logged. Release it after
 * success. */
static dds_entity_t have_participant(struct fl_block *block, uint32_t number, struct fl_reasons *reasons)
{
    dds_entity_t participant = DDS_RETCODE_OUT_OF_RESOURCES;
    pthread_mutex_lock(&lock);
    struct domain *domain = domain_numbered(number);
    if (!domain)
        fl_reasons_log(reasons, block, fl_now_ns(), "DDS domain %u: a task has %d domains at most", (unsigned)number,
                       DOMAINS);
    if (domain && !domain->users) {
        char reason[WHY_BYTES] = "";
        dds_set_log_sink(write_log, NULL);
        why = reason;
        domain->participant = create(domain);
        why = NULL;
        log_domain(block, domain, reason);
    }
    if (domain && (participant = domain->participant) >= 0)
        domain->users++;
    pthread_mutex_unlock(&lock);
    return participant;
}

static void release_participant(uint32_t number)
{
    pthread_mutex_lock(&lock);
    struct domain *domain = domain_numbered(number);
    if (--domain->users == 0)
        dds_delete(domain->whole);
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
                  struct fl_driver *driver, void *context, dds_entity_t participant, struct fl_reasons *reasons)
{
    dds_listener_t *listener = dds_create_listener(context);
    dds_qos_t *qualities = qualities_of(topic);
    endpoint->set_listener(listener);
    dds_entity_t described = dds_create_topic(participant, topic->type, topic->name, NULL, NULL);
    dds_entity_t entity = described < 0 ? described : endpoint->create(participant, described, qualities, listener);
    dds_delete_qos(qualities);
    dds_delete_listener(listener);
    if (entity < 0) {
        fl_reasons_log(reasons, block, fl_now_ns(), "topic %s: %s; retrying", topic->name, dds_strretcode(entity));
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
    struct fl_reasons reasons = {0};
    do {
        dds_entity_t participant = have_participant(block, topic->domain, &reasons);
        if (participant < 0)
            continue;
        bool done = serve(endpoint, topic, block, driver, context, participant, &reasons);
        release_participant(topic->domain);
        if (done)
            return;
    } while (fl_driver_wait(driver, -1, false, RETRY_MS) == 0);
}
