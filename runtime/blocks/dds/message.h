/* The messages of runtime/idl/ros.idl as ports: one for each member that is a number, an array or a sequence. */
#ifndef FLOTILLA_DDS_MESSAGE_H
#define FLOTILLA_DDS_MESSAGE_H

#include "endpoint.h"

enum { MESSAGE_FIELDS = 16, MESSAGE_SEQUENCES = 2 }; /* at most, of a type */
enum { MESSAGE_ELEMENTS = 10000 };                   /* at most, of a sequence */

/* What a message says where nobody knows the value: what ROS defines for that. */
enum message_absent {
    MESSAGE_ZERO,
    MESSAGE_NAN,    /* of a single float */
    MESSAGE_UNKNOWN /* zeros, and -1 in the first element of the covariance, which is the next member */
};

struct message_field {
    const char *name;
    enum fl_type type;
    uint32_t width; /* 0: a sequence, whose length is a parameter */
    bool needed;    /* or a sequence with a length: the input needs a wire */
    enum message_absent absent;
    const char *unit, *summary;
    size_t offset; /* in the C structure */
};

/* A string that is a parameter; its offset in the C structure, or 0: the type has none. */
struct message_strings {
    size_t child_frame_id, location, serial_number;
};

struct message_type {
    const dds_topic_descriptor_t *descriptor;
    const char *hash; /* USER_DATA of writers and readers since ROS 2 Iron (REP 2011), of tests/runtime/test_ros.py */
    bool header;      /* it begins with std_msgs/msg/Header: stamp and frame_id */
    struct message_strings strings;
    struct message_field fields[MESSAGE_FIELDS];
};

/* Parameters that both blocks have. */
struct message_settings {
    int type;
    const char *topic;
    struct fl_doubles lengths;
    int64_t domain;
    int reliability;
    double deadline;
};

#define MESSAGE_PARAMETERS(usual_reliability)                                                                          \
    FL_PARAMETER(struct message_settings, type,                                                                        \
                 .choices = "geometry_msgs/msg/Twist|nav_msgs/msg/Odometry|sensor_msgs/msg/LaserScan|"                 \
                            "sensor_msgs/msg/Imu|sensor_msgs/msg/BatteryState|sensor_msgs/msg/Joy",                    \
                 .summary = "type of the message, as ROS calls it"),                                                   \
        FL_PARAMETER(struct message_settings, topic,                                                                   \
                     .summary = "name of the topic, as ROS calls it, with its namespace: robot3/cmd_vel"),             \
        FL_PARAMETER(struct message_settings, lengths, .default_value = "", .min = 0, .max = MESSAGE_ELEMENTS,         \
                     .summary = "elements of each sequence of the type, in the order of its ports; 0, also where the " \
                                "list ends: the sequence is empty, and has no port"),                                  \
        DDS_QUALITIES(struct message_settings, usual_reliability)

/* A message on its way between step and DDS. `values` are those of the ports. */
struct message {
    int64_t time_ns;  /* CLOCK_MONOTONIC: when it was made, or arrived */
    int64_t stamp_ns; /* the header's, CLOCK_REALTIME */
    _Alignas(8) uint8_t values[];
};

/* A type with its lengths: what the ports are, and where their values lie. */
struct message_layout {
    const struct message_type *type;
    uint32_t count;
    struct message_port {
        const struct message_field *field;
        uint32_t width;
        size_t offset; /* in `values` */
    } ports[MESSAGE_FIELDS];
    uint32_t empty; /* sequences without a port */
    size_t empty_offsets[MESSAGE_SEQUENCES];
    size_t bytes; /* of a struct message with its values */
    char topic[256];
};

/* Judge the parameters, and lay the ports out. */
int message_lay_out(struct fl_block *block, const struct message_settings *settings, struct message_layout *layout);

/* Add each port by fl_add_input or fl_add_output; `optional`: the flags of those that are not needed. */
int message_add_ports(struct fl_block *block, const struct message_layout *layout, unsigned optional,
                      int (*add)(struct fl_block *block, struct fl_port port));

/* The DDS topic, but for a lifespan. */
struct dds_topic message_topic(const struct message_layout *layout, const struct message_settings *settings);

/* Bytes of any type's C structure. */
size_t message_storage_bytes(void);

/* The frame_id of a message with a header, and its offset. */
const char *message_frame(const void *storage);

enum { MESSAGE_FRAME = 8 };

/* Copy a string to the C structure, at that offset; it fits (message_string_fits). */
void message_set_string(void *storage, size_t offset, const char *string);
bool message_string_fits(const char *string);

/* Between a message and the type's C structure. `absent`: a bit for each port whose value nobody knows. Encoding leaves
 * strings as they are, and the structure points to the message's values. */
void message_encode(const struct message_layout *layout, const struct message *message, uint32_t absent, void *storage);
/* False: a sequence is shorter than its port. Further elements are left out. */
bool message_decode(const struct message_layout *layout, const void *storage, struct message *message);

#endif
