/* The types of runtime/idl/flotilla.idl as ports. */
#ifndef FLOTILLA_DDS_TOPIC_H
#define FLOTILLA_DDS_TOPIC_H

#include "endpoint.h"

/* A sample on its way between step and DDS, of at most DDS_VALUES bytes of values. */
enum { DDS_VALUES = 1024 };
struct dds_sample {
    int64_t time_ns; /* CLOCK_MONOTONIC: when it was made, or arrived */
    uint16_t robot;
    uint32_t number;
    uint32_t sender;  /* its rank, where it arrives */
    int64_t stamp_ns; /* the sender's CLOCK_REALTIME */
    _Alignas(8) uint8_t values[DDS_VALUES];
};

struct dds_settings {
    int type;
    const char *topic;
    int64_t domain, bytes;
    int reliability;
    double deadline;
    int partition;
};

enum dds_partition { DDS_DEFAULT_PARTITION, DDS_ROBOTS_PARTITION };

#define DDS_PARAMETERS                                                                                                 \
    FL_PARAMETER(struct dds_settings, type, .choices = "state|wrench|valves|bytes",                                    \
                 .summary = "type of the topic, of flotilla.idl"),                                                     \
        FL_PARAMETER(struct dds_settings, topic, .summary = "name of the topic"),                                      \
        FL_PARAMETER(struct dds_settings, bytes, .default_value = "64", .min = 1, .max = DDS_VALUES, .unit = "B",      \
                     .summary = "length of a sample of type `bytes`"),                                                 \
        FL_PARAMETER(struct dds_settings, partition, .default_value = "default", .choices = "default|robot",           \
                     .summary = "robot: samples go through the DDS partition `robotN`, with the number of the robot "  \
                                "that sends, into which permissions of DDS Security can let that robot alone"),        \
        DDS_QUALITIES(struct dds_settings, "best-effort")

/* The topic that the parameters describe, but for a lifespan. */
struct dds_topic dds_topic(const struct dds_settings *settings);

/* Send, or listen, through that robot's partition, too, where the parameters say so. At most FL_SENDERS times. */
void dds_enter_partition(struct dds_topic *topic, const struct dds_settings *settings, uint16_t robot);

/* The robot whose partition the writer is in, which sends to that reader; -1: none, more than one, or it has gone. */
int dds_robot_of_partition(dds_entity_t reader, dds_instance_handle_t writer);

/* The port that carries the type's values. */
struct fl_port dds_port(const struct dds_settings *settings);

/* Bytes of those values. */
size_t dds_value_bytes(const struct dds_settings *settings);

/* Between a sample and the type's C structure, in `storage`. */
size_t dds_storage_bytes(void);
void dds_encode(const struct dds_settings *settings, const struct dds_sample *sample, void *storage);
/* False: of another length. */
bool dds_decode(const struct dds_settings *settings, const void *storage, struct dds_sample *sample);

#endif
