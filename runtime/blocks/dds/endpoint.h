/* Writers and readers of DDS topics: qualities of service, and the participant, of which a program has one for each
 * domain.
 *
 * DDS allocates and may take milliseconds, so no step calls it: samples pass through triple buffers to and from a
 * thread of the block or of DDS (sender.h, receiver.h). $CYCLONEDDS_URI sets addresses, peers, interfaces and
 * priorities for all tasks of a robot.
 */
#ifndef FLOTILLA_DDS_ENDPOINT_H
#define FLOTILLA_DDS_ENDPOINT_H

#include <dds/dds.h>
#include <flotilla/driver.h>
#include <flotilla/failover.h>

/* Parameters that all blocks have: members `domain`, `reliability` and `deadline` of the structure. */
#define DDS_QUALITIES(settings_type, usual_reliability)                                                                \
    FL_PARAMETER(settings_type, domain, .default_value = "0", .min = 0, .max = 230,                                    \
                 .summary = "DDS domain: tasks of different domains do not see each other"),                           \
        FL_PARAMETER(settings_type, reliability, .default_value = (usual_reliability),                                 \
                     .choices = "best-effort|reliable",                                                                \
                     .summary = "whether lost samples are sent again, as long as they are the newest"),                \
        FL_PARAMETER(settings_type, deadline, .default_value = "0", .min = 0, .max = 1e6, .unit = "s",                 \
                     .summary = "DDS deadline: longest time between samples; 0: none")

/* The parameter `double lifespan` of a publisher. */
#define DDS_LIFESPAN(block_type)                                                                                       \
    FL_PARAMETER(block_type, lifespan, .default_value = "0.1", .min = 0.001, .max = 3600, .unit = "s",                 \
                 .summary = "older samples are not sent, nor sent again: they would look new to the subscriber")

enum { DDS_PARTITION_BYTES = 16 };

struct dds_topic {
    const dds_topic_descriptor_t *type;
    const char *name;
    const char *user_data; /* of writer or reader; NULL: none */
    uint32_t domain;
    bool reliable;
    double deadline;          /* s; 0: none */
    double lifespan;          /* s, of samples that are written; 0 for readers */
    uint32_t partition_count; /* 0: DDS's default partition */
    char partitions[FL_SENDERS][DDS_PARTITION_BYTES];
};

/* A writer or reader of a topic. */
struct dds_endpoint {
    dds_entity_t (*create)(dds_entity_t participant, dds_entity_t topic, const dds_qos_t *qualities,
                           const dds_listener_t *listener);
    void (*set_listener)(dds_listener_t *listener); /* set the callbacks, with the context given to dds_run */
    void (*serve)(void *context, struct fl_driver *driver,
                  dds_entity_t entity); /* serve until the thread has to return */
};

/* The thread of a block: create the endpoint and serve it; try again while DDS is not available. */
void dds_run(const struct dds_endpoint *endpoint, const struct dds_topic *topic, struct fl_block *block,
             struct fl_driver *driver, void *context);

#endif
