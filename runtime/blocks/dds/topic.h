/* What publisher and subscriber share: the types of runtime/idl/flotilla.idl as ports, qualities of service, and the
 * participant, of which a program has one for each domain.
 *
 * DDS allocates and may take milliseconds, so no step calls it: samples pass through rings to and from a thread of the
 * block or of DDS. $CYCLONEDDS_URI sets addresses, peers, interfaces and priorities for all tasks of a robot.
 */
#ifndef FLOTILLA_DDS_TOPIC_H
#define FLOTILLA_DDS_TOPIC_H

#include <dds/dds.h>
#include <flotilla/driver.h>

/* A sample on its way between step and DDS, of at most DDS_VALUES bytes of values. */
enum { DDS_VALUES = 1024 };
struct dds_sample {
    uint16_t robot;
    uint32_t number;
    uint32_t sender;    /* its rank, where it arrives */
    int64_t stamp_ns;   /* the sender's CLOCK_REALTIME */
    int64_t made_ns;    /* CLOCK_MONOTONIC, of one that goes out */
    int64_t arrived_ns; /* CLOCK_MONOTONIC, of one that came */
    _Alignas(8) uint8_t values[DDS_VALUES];
};

struct dds_settings {
    int type;
    const char *topic;
    int64_t domain, bytes;
    int reliability;
    double deadline;
};

#define DDS_PARAMETERS(block_type)                                                                                     \
    FL_PARAMETER(block_type, type, .choices = "state|wrench|valves|bytes",                                             \
                 .summary = "type of the topic, of flotilla.idl"),                                                     \
        FL_PARAMETER(block_type, topic, .summary = "name of the topic"),                                               \
        FL_PARAMETER(block_type, domain, .default_value = "0", .min = 0, .max = 230,                                   \
                     .summary = "DDS domain: tasks of different domains do not see each other"),                       \
        FL_PARAMETER(block_type, bytes, .default_value = "64", .min = 1, .max = DDS_VALUES, .unit = "B",               \
                     .summary = "length of a sample of type `bytes`"),                                                 \
        FL_PARAMETER(block_type, reliability, .default_value = "best-effort", .choices = "best-effort|reliable",       \
                     .summary = "whether lost samples are sent again, as long as they are the newest"),                \
        FL_PARAMETER(block_type, deadline, .default_value = "0", .min = 0, .max = 1e6, .unit = "s",                    \
                     .summary = "DDS deadline: longest time between samples; 0: none")

/* The port that carries the type's values. */
struct fl_port dds_port(const struct dds_settings *settings);

/* Bytes of those values. */
size_t dds_value_bytes(const struct dds_settings *settings);

/* Between a sample and the type's C structure, in `storage`. */
size_t dds_storage_bytes(void);
void dds_encode(const struct dds_settings *settings, const struct dds_sample *sample, void *storage);
/* False: of another length. */
bool dds_decode(const struct dds_settings *settings, const void *storage, struct dds_sample *sample);

/* A writer or reader of a topic. */
struct dds_endpoint {
    dds_entity_t (*create)(dds_entity_t participant, dds_entity_t topic, const dds_qos_t *qualities,
                           const dds_listener_t *listener);
    void (*set_listener)(dds_listener_t *listener); /* set the callbacks, with the context given to dds_run */
    void (*serve)(void *context, struct fl_driver *driver,
                  dds_entity_t entity); /* serve until the thread has to return */
};

/* The thread of a block: create the endpoint and serve it; try again while DDS is not available. `lifespan` of samples
 * that are written, in s: 0 for readers. */
void dds_run(const struct dds_endpoint *endpoint, const struct dds_settings *settings, double lifespan,
             struct fl_block *block, struct fl_driver *driver, void *context);

#endif
