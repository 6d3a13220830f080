#include "topic.h"

#include "flotilla.h"

#include <math.h>
#include <pthread.h>
#include <string.h>

union dds_storage {
    flotilla_State state;
    flotilla_Wrench wrench;
    flotilla_Valves valves;
    flotilla_Bytes bytes;
};

enum { STATE, WRENCH, VALVES, BYTES };

/* The values of a type lie one after the other: an array, or members of one type. */
#define VALUES(type, first, last)                                                                                      \
    offsetof(type, first), offsetof(type, last) + sizeof(((type *)NULL)->last) - offsetof(type, first)

static const struct {
    const dds_topic_descriptor_t *descriptor;
    struct fl_port port;
    size_t offset, bytes;
} types[] = {
    [STATE] = {&flotilla_State_desc,
               {.name = "state",
                .type = FL_DOUBLE,
                .width = 6,
                .summary = "x and y (m), heading (rad), and their rates (m/s, m/s, rad/s)"},
               VALUES(flotilla_State, x, heading_rate)},
    [WRENCH] = {&flotilla_Wrench_desc,
                {.name = "wrench", .type = FL_DOUBLE, .width = 3, .summary = "forces along x and y (N), torque (N·m)"},
                VALUES(flotilla_Wrench, x_force, torque)},
    [VALVES] = {&flotilla_Valves_desc,
                {.name = "valves", .type = FL_BOOLEAN, .width = 8, .summary = "1: open"},
                VALUES(flotilla_Valves, open, open)},
    [BYTES] = {&flotilla_Bytes_desc, {.name = "data", .type = FL_UINT8, .summary = "bytes, as packed"}, 0, 0},
};

_Static_assert(sizeof(bool) == 1, "a boolean port has one byte");
_Static_assert(offsetof(flotilla_State, heading_rate) - offsetof(flotilla_State, x) == 5 * sizeof(double), "no gaps");
_Static_assert(offsetof(flotilla_Wrench, torque) - offsetof(flotilla_Wrench, x_force) == 2 * sizeof(double), "no gaps");
_Static_assert(flotilla_MOST_BYTES == DDS_VALUES, "one limit");

struct fl_port dds_port(const struct dds_settings *settings)
{
    struct fl_port port = types[settings->type].port;
    if (settings->type == BYTES)
        port.width = (uint32_t)settings->bytes;
    return port;
}

size_t dds_value_bytes(const struct dds_settings *settings)
{
    return settings->type == BYTES ? (size_t)settings->bytes : types[settings->type].bytes;
}

size_t dds_storage_bytes(void)
{
    return sizeof(union dds_storage);
}

void dds_encode(const struct dds_settings *settings, const struct dds_sample *sample, void *storage)
{
    /* The header comes first in each type. */
    *(flotilla_Header *)storage = (flotilla_Header){sample->robot, sample->number, sample->stamp_ns};
    if (settings->type == BYTES) /* DDS only reads it */
        ((flotilla_Bytes *)storage)->data = (dds_sequence_octet){(uint32_t)settings->bytes, (uint32_t)settings->bytes,
                                                                 (uint8_t *)(uintptr_t)sample->values, false};
    else
        memcpy((char *)storage + types[settings->type].offset, sample->values, types[settings->type].bytes);
}

bool dds_decode(const struct dds_settings *settings, const void *storage, struct dds_sample *sample)
{
    const flotilla_Header *header = storage;
    const dds_sequence_octet *data = &((const flotilla_Bytes *)storage)->data;
    if (settings->type == BYTES && data->_length != settings->bytes)
        return false;
    memcpy(sample->values,
           settings->type == BYTES ? data->_buffer : (const uint8_t *)storage + types[settings->type].offset,
           dds_value_bytes(settings));
    sample->robot = header->robot;
    sample->number = header->number;
    sample->stamp_ns = header->stamp;
    return true;
}

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

static dds_qos_t *qualities_of(const struct dds_settings *settings, double lifespan)
{
    dds_qos_t *qualities = dds_create_qos();
    dds_qset_history(qualities, DDS_HISTORY_KEEP_LAST, 1); /* control needs the newest sample only */
    dds_qset_reliability(qualities, settings->reliability ? DDS_RELIABILITY_RELIABLE : DDS_RELIABILITY_BEST_EFFORT,
                         DDS_MSECS(100));
    if (settings->deadline > 0)
        dds_qset_deadline(qualities, llround(settings->deadline * 1e9));
    if (settings->reliability && lifespan > 0) /* best effort keeps nothing that could be sent again */
        dds_qset_lifespan(qualities, llround(lifespan * 1e9));
    return qualities;
}

/* Serve until the thread has to return: true; false when DDS is not available now. */
static bool serve(const struct dds_endpoint *endpoint, const struct dds_settings *settings, double lifespan,
                  struct fl_block *block, struct fl_driver *driver, void *context, dds_entity_t participant)
{
    dds_listener_t *listener = dds_create_listener(context);
    dds_qos_t *qualities = qualities_of(settings, lifespan);
    endpoint->set_listener(listener);
    dds_entity_t topic = dds_create_topic(participant, types[settings->type].descriptor, settings->topic, NULL, NULL);
    dds_entity_t entity = topic < 0 ? topic : endpoint->create(participant, topic, qualities, listener);
    dds_delete_qos(qualities);
    dds_delete_listener(listener);
    if (entity < 0) {
        fl_log(block, "topic %s: %s", settings->topic, dds_strretcode(entity));
    } else {
        endpoint->serve(context, driver, entity);
        dds_delete(entity); /* waits for a listener that is being called */
    }
    if (topic >= 0)
        dds_delete(topic);
    return entity >= 0;
}

void dds_run(const struct dds_endpoint *endpoint, const struct dds_settings *settings, double lifespan,
             struct fl_block *block, struct fl_driver *driver, void *context)
{
    uint32_t domain = (uint32_t)settings->domain;
    do {
        dds_entity_t participant = have_participant(domain);
        if (participant < 0) {
            fl_log(block, "DDS domain %u: %s", (unsigned)domain, dds_strretcode(participant));
            continue;
        }
        bool done = serve(endpoint, settings, lifespan, block, driver, context, participant);
        release_participant(domain);
        if (done)
            return;
    } while (fl_driver_wait(driver, -1, false, RETRY_MS) == 0);
}
