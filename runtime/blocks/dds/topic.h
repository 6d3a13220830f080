/* What publisher and subscriber have in common: the types of runtime/idl/flotilla.idl as ports, qualities of service,
 * and the participant, which all blocks of a program and domain share.
 *
 * DDS allocates and may take milliseconds now and then, so no step calls it: samples pass through rings, and a thread
 * of the block's or of DDS's own is on the other side. Addresses, peers, interfaces and priorities are the business of
 * $CYCLONEDDS_URI, which the robot's configuration sets for all its tasks. */
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
        FL_PARAMETER(block_type, domain, .fallback = "0", .min = 0, .max = 230,                                        \
                     .summary = "DDS domain: tasks of different domains do not see each other"),                       \
        FL_PARAMETER(block_type, bytes, .fallback = "64", .min = 1, .max = DDS_VALUES, .unit = "B",                    \
                     .summary = "length of a sample of type `bytes`"),                                                 \
        FL_PARAMETER(block_type, reliability, .fallback = "best-effort", .choices = "best-effort|reliable",            \
                     .summary = "whether lost samples are sent again, as long as they are the newest"),                \
        FL_PARAMETER(block_type, deadline, .fallback = "0", .min = 0, .max = 1e6, .unit = "s",                         \
                     .summary = "longest time between samples that is promised, or asked for; 0: none")

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
    void (*set_listener)(dds_listener_t *listener); /* say what is to be called, with the context given to dds_run */
    void (*serve)(void *context, struct fl_driver *driver, dds_entity_t entity); /* until the thread shall return */
};

/* What a block's thread does: have the endpoint, and serve it; try again while DDS cannot be had. `lifespan` of a
 * writer's samples, in s: 0 is for readers. */
void dds_run(const struct dds_endpoint *endpoint, const struct dds_settings *settings, double lifespan,
             struct fl_block *block, struct fl_driver *driver, void *context);

#endif
