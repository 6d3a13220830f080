#include "message.h"

#include "ros.h"

#include <ctype.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

#define TWIST    geometry_msgs_msg_dds__Twist_
#define ODOMETRY nav_msgs_msg_dds__Odometry_
#define SCAN     sensor_msgs_msg_dds__LaserScan_
#define IMU      sensor_msgs_msg_dds__Imu_
#define BATTERY  sensor_msgs_msg_dds__BatteryState_
#define JOY      sensor_msgs_msg_dds__Joy_

union storage {
    TWIST twist;
    ODOMETRY odometry;
    SCAN scan;
    IMU imu;
    BATTERY battery;
    JOY joy;
};

/* In the order of MESSAGE_PARAMETERS; ports in the order of the message. Units are REP 103's. */
static const struct message_type types[] = {
    {&geometry_msgs_msg_dds__Twist__desc,
     "typehash=RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a;",
     .fields = {{"linear", FL_DOUBLE, 3, true, MESSAGE_ZERO, "m/s", "velocity along x, y, z", offsetof(TWIST, linear)},
                {"angular", FL_DOUBLE, 3, true, MESSAGE_ZERO, "rad/s", "rate about x, y, z",
                 offsetof(TWIST, angular)}}},
    {&nav_msgs_msg_dds__Odometry__desc,
     "typehash=RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0;", true,
     .strings.child_frame_id = offsetof(ODOMETRY, child_frame_id),
     .fields = {{"position", FL_DOUBLE, 3, true, MESSAGE_ZERO, "m", "in frame_id", offsetof(ODOMETRY, pose.pose)},
                {"orientation", FL_DOUBLE, 4, true, MESSAGE_ZERO, NULL, "quaternion x, y, z, w",
                 offsetof(ODOMETRY, pose.pose.orientation)},
                {"pose_covariance", FL_DOUBLE, 36, false, MESSAGE_ZERO, NULL,
                 "of x, y, z (m) and rotations about them (rad), row by row", offsetof(ODOMETRY, pose.covariance)},
                {"linear", FL_DOUBLE, 3, true, MESSAGE_ZERO, "m/s", "velocity in child_frame_id",
                 offsetof(ODOMETRY, twist.twist.linear)},
                {"angular", FL_DOUBLE, 3, true, MESSAGE_ZERO, "rad/s", "rate in child_frame_id",
                 offsetof(ODOMETRY, twist.twist.angular)},
                {"twist_covariance", FL_DOUBLE, 36, false, MESSAGE_ZERO, NULL, "of both, row by row",
                 offsetof(ODOMETRY, twist.covariance)}}},
    {&sensor_msgs_msg_dds__LaserScan__desc,
     "typehash=RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828;", true,
     .fields = {{"angle_min", FL_SINGLE, 1, true, MESSAGE_ZERO, "rad", "direction of the first range, from x to y",
                 offsetof(SCAN, angle_min)},
                {"angle_max", FL_SINGLE, 1, true, MESSAGE_ZERO, "rad", "direction of the last range",
                 offsetof(SCAN, angle_max)},
                {"angle_increment", FL_SINGLE, 1, true, MESSAGE_ZERO, "rad", "from one range to the next",
                 offsetof(SCAN, angle_increment)},
                {"time_increment", FL_SINGLE, 1, false, MESSAGE_ZERO, "s", "from one range to the next",
                 offsetof(SCAN, time_increment)},
                {"scan_time", FL_SINGLE, 1, false, MESSAGE_ZERO, "s", "from one scan to the next",
                 offsetof(SCAN, scan_time)},
                {"range_min", FL_SINGLE, 1, true, MESSAGE_ZERO, "m", "shorter ranges are not measurements",
                 offsetof(SCAN, range_min)},
                {"range_max", FL_SINGLE, 1, true, MESSAGE_ZERO, "m", "longer ranges are not measurements",
                 offsetof(SCAN, range_max)},
                {"ranges", FL_SINGLE, 0, true, MESSAGE_ZERO, "m", "distance in each direction", offsetof(SCAN, ranges)},
                {"intensities", FL_SINGLE, 0, false, MESSAGE_ZERO, NULL, "of the echoes, in the sensor's own unit",
                 offsetof(SCAN, intensities)}}},
    {&sensor_msgs_msg_dds__Imu__desc,
     "typehash=RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b;", true,
     .fields = {{"orientation", FL_DOUBLE, 4, false, MESSAGE_UNKNOWN, NULL, "quaternion x, y, z, w",
                 offsetof(IMU, orientation)},
                {"orientation_covariance", FL_DOUBLE, 9, false, MESSAGE_ZERO, "rad²",
                 "row by row; zeros: unknown; -1 first: no orientation", offsetof(IMU, orientation_covariance)},
                {"angular_velocity", FL_DOUBLE, 3, false, MESSAGE_UNKNOWN, "rad/s", "about x, y, z",
                 offsetof(IMU, angular_velocity)},
                {"angular_velocity_covariance", FL_DOUBLE, 9, false, MESSAGE_ZERO, "rad²/s²", "likewise",
                 offsetof(IMU, angular_velocity_covariance)},
                {"linear_acceleration", FL_DOUBLE, 3, false, MESSAGE_UNKNOWN, "m/s²", "along x, y, z",
                 offsetof(IMU, linear_acceleration)},
                {"linear_acceleration_covariance", FL_DOUBLE, 9, false, MESSAGE_ZERO, "m²/s⁴", "likewise",
                 offsetof(IMU, linear_acceleration_covariance)}}},
    {&sensor_msgs_msg_dds__BatteryState__desc,
     "typehash=RIHS01_4bee5dfce981c98faa6828b868307a0a73f992ed0789f374ee96c8f840e69741;", true,
     .strings = {.location = offsetof(BATTERY, location), .serial_number = offsetof(BATTERY, serial_number)},
     .fields = {{"voltage", FL_SINGLE, 1, true, MESSAGE_NAN, "V", "", offsetof(BATTERY, voltage)},
                {"temperature", FL_SINGLE, 1, false, MESSAGE_NAN, "°C", "NaN: unknown", offsetof(BATTERY, temperature)},
                {"current", FL_SINGLE, 1, false, MESSAGE_NAN, "A", "negative when it discharges; NaN: unknown",
                 offsetof(BATTERY, current)},
                {"charge", FL_SINGLE, 1, false, MESSAGE_NAN, "A·h", "now; NaN: unknown", offsetof(BATTERY, charge)},
                {"capacity", FL_SINGLE, 1, false, MESSAGE_NAN, "A·h", "when last full; NaN: unknown",
                 offsetof(BATTERY, capacity)},
                {"design_capacity", FL_SINGLE, 1, false, MESSAGE_NAN, "A·h", "when new; NaN: unknown",
                 offsetof(BATTERY, design_capacity)},
                {"percentage", FL_SINGLE, 1, false, MESSAGE_NAN, "1", "charge from 0 to 1; NaN: unknown",
                 offsetof(BATTERY, percentage)},
                {"power_supply_status", FL_UINT8, 1, false, MESSAGE_ZERO, NULL,
                 "0 unknown, 1 charging, 2 discharging, 3 not charging, 4 full",
                 offsetof(BATTERY, power_supply_status)},
                {"power_supply_health", FL_UINT8, 1, false, MESSAGE_ZERO, NULL,
                 "0 unknown, 1 good, 2 too hot, 3 dead, 4 overvoltage, 5 other failure, 6 too cold, 7 or 8 a timer "
                 "expired",
                 offsetof(BATTERY, power_supply_health)},
                {"power_supply_technology", FL_UINT8, 1, false, MESSAGE_ZERO, NULL,
                 "0 unknown, 1 NiMH, 2 Li-ion, 3 Li-polymer, 4 LiFe, 5 NiCd, 6 LiMn",
                 offsetof(BATTERY, power_supply_technology)},
                {"present", FL_BOOLEAN, 1, true, MESSAGE_ZERO, NULL, "1: there is a battery",
                 offsetof(BATTERY, present)},
                {"cell_voltage", FL_SINGLE, 0, false, MESSAGE_ZERO, "V", "of each cell; NaN: unknown",
                 offsetof(BATTERY, cell_voltage)},
                {"cell_temperature", FL_SINGLE, 0, false, MESSAGE_ZERO, "°C", "of each cell; NaN: unknown",
                 offsetof(BATTERY, cell_temperature)}}},
    {&sensor_msgs_msg_dds__Joy__desc,
     "typehash=RIHS01_0d356c79cad3401e35ffeb75a96a96e08be3ef896b8b83841d73e890989372c5;", true,
     .fields = {{"axes", FL_SINGLE, 0, false, MESSAGE_ZERO, NULL, "-1 to 1", offsetof(JOY, axes)},
                {"buttons", FL_INT32, 0, false, MESSAGE_ZERO, NULL, "1: pressed", offsetof(JOY, buttons)}}},
};

/* The header comes first where there is one. */
_Static_assert(offsetof(ODOMETRY, header) == 0 && offsetof(SCAN, header) == 0 && offsetof(IMU, header) == 0 &&
                   offsetof(BATTERY, header) == 0 && offsetof(JOY, header) == 0,
               "first");
_Static_assert(offsetof(std_msgs_msg_dds__Header_, frame_id) == MESSAGE_FRAME, "as the header file says");
_Static_assert(ros_limits_MOST_ELEMENTS == MESSAGE_ELEMENTS, "one limit");
/* Sequences of any elements have one layout. */
_Static_assert(sizeof(dds_sequence_float) == sizeof(dds_sequence_t) &&
                   offsetof(dds_sequence_float, _buffer) == offsetof(dds_sequence_t, _buffer),
               "one layout");
_Static_assert(sizeof(bool) == 1 && sizeof(geometry_msgs_msg_dds__Vector3_) == 3 * sizeof(double) &&
                   sizeof(geometry_msgs_msg_dds__Quaternion_) == 4 * sizeof(double),
               "as ports");

static const size_t most_characters = sizeof(((std_msgs_msg_dds__Header_ *)NULL)->frame_id) - 1;

/* Whether each part of the name, between slashes, is a name:
 * https://design.ros2.org/articles/topic_and_service_names.html
 */
static bool is_ros_name(const char *name)
{
    do {
        if (!isalpha((unsigned char)*name) && *name != '_')
            return false;
        while (isalnum((unsigned char)*name) || *name == '_')
            name++;
    } while (*name == '/' && name++);
    return !*name;
}

static int name_topic(struct fl_block *block, const char *name, char *topic, size_t size)
{
    const char *plain = *name == '/' ? name + 1 : name;
    if (!is_ros_name(plain))
        return fl_fail(block,
                       "parameter topic: %s: is no topic of ROS: give parts of letters, digits and _, none of which "
                       "begins with a digit, with / between them",
                       name);
    if ((size_t)snprintf(topic, size, "rt/%s", plain) >= size)
        return fl_fail(block, "parameter topic: has %zu characters, give at most %zu", strlen(name), size - 4);
    return FL_OK;
}

/* The length of the type's next sequence. */
static int next_length(struct fl_block *block, const struct fl_doubles *lengths, size_t sequence, uint32_t *length)
{
    double value = sequence < lengths->count ? lengths->value[sequence] : 0;
    if (value != floor(value))
        return fl_fail(block, "parameter lengths: %g is not a whole number", value);
    *length = (uint32_t)value;
    return FL_OK;
}

int message_lay_out(struct fl_block *block, const struct message_settings *settings, struct message_layout *layout)
{
    size_t bytes = 0, sequences = 0;
    *layout = (struct message_layout){.type = &types[settings->type]};
    for (const struct message_field *field = layout->type->fields; field->name; field++) {
        uint32_t width = field->width;
        if (!width && next_length(block, &settings->lengths, sequences++, &width) != FL_OK)
            return FL_FAILED;
        if (!width && field->needed)
            return fl_fail(block, "parameter lengths: %s has no elements: give its length", field->name);
        if (!width) {
            layout->empty_offsets[layout->empty++] = field->offset;
            continue;
        }
        layout->ports[layout->count++] = (struct message_port){field, width, bytes};
        bytes += (fl_type_size(field->type) * width + 7) / 8 * 8;
    }
    if (settings->lengths.count > sequences)
        return fl_fail(block, "parameter lengths: has %zu numbers, and the type has %zu sequences",
                       settings->lengths.count, sequences);
    if (!layout->count)
        return fl_fail(block, "parameter lengths: the type has sequences only, and all are empty: give their lengths");
    layout->bytes = sizeof(struct message) + bytes;
    return name_topic(block, settings->topic, layout->topic, sizeof layout->topic);
}

int message_add_ports(struct fl_block *block, const struct message_layout *layout, unsigned optional,
                      int (*add)(struct fl_block *block, struct fl_port port))
{
    int failed = FL_OK;
    for (uint32_t i = 0; i < layout->count; i++) {
        const struct message_field *field = layout->ports[i].field;
        failed |= add(block, (struct fl_port){.name = field->name,
                                              .type = field->type,
                                              .width = layout->ports[i].width,
                                              .flags = field->needed || !field->width ? 0 : optional,
                                              .unit = field->unit,
                                              .summary = field->summary});
    }
    return failed;
}

struct dds_topic message_topic(const struct message_layout *layout, const struct message_settings *settings)
{
    return (struct dds_topic){
        .type = layout->type->descriptor,
        .name = layout->topic,
        .user_data = layout->type->hash,
        .domain = (uint32_t)settings->domain,
        .reliable = settings->reliability,
        .deadline = settings->deadline,
    };
}

size_t message_storage_bytes(void)
{
    return sizeof(union storage);
}

const char *message_frame(const void *storage)
{
    return ((const std_msgs_msg_dds__Header_ *)storage)->frame_id;
}

bool message_string_fits(const char *string)
{
    return strlen(string) <= most_characters;
}

void message_set_string(void *storage, size_t offset, const char *string)
{
    strncpy((char *)storage + offset, string, most_characters);
}

/* What stands for a value that nobody knows. Zeros are there already. */
static void set_absent(const struct message_field *field, char *place)
{
    const float unknown = NAN;
    const double none = -1;
    if (field->absent == MESSAGE_NAN)
        memcpy(place, &unknown, sizeof unknown);
    if (field->absent == MESSAGE_UNKNOWN)
        memcpy(place + fl_type_size(field->type) * field->width, &none, sizeof none);
}

void message_encode(const struct message_layout *layout, const struct message *message, uint32_t absent, void *storage)
{
    if (layout->type->header)
        ((std_msgs_msg_dds__Header_ *)storage)->stamp = (builtin_interfaces_msg_dds__Time_){
            (int32_t)(message->stamp_ns / 1000000000), (uint32_t)(message->stamp_ns % 1000000000)};
    for (uint32_t i = 0; i < layout->empty; i++)
        *(dds_sequence_t *)((char *)storage + layout->empty_offsets[i]) = (dds_sequence_t){0};
    for (uint32_t i = 0; i < layout->count; i++) {
        const struct message_port *port = &layout->ports[i];
        char *place = (char *)storage + port->field->offset;
        uint8_t *values = (uint8_t *)(uintptr_t)message->values + port->offset; /* DDS only reads it */
        if (!port->field->width)
            *(dds_sequence_t *)place = (dds_sequence_t){port->width, port->width, values, false};
        else if (!(absent & 1u << i))
            memcpy(place, values, fl_type_size(port->field->type) * port->width);
    }
    /* Afterwards, for a covariance may be wired. */
    for (uint32_t i = 0; i < layout->count; i++)
        if (absent & 1u << i)
            set_absent(layout->ports[i].field, (char *)storage + layout->ports[i].field->offset);
}

bool message_decode(const struct message_layout *layout, const void *storage, struct message *message)
{
    const builtin_interfaces_msg_dds__Time_ *stamp = storage;
    for (uint32_t i = 0; i < layout->count; i++) {
        const struct message_port *port = &layout->ports[i];
        const void *place = (const char *)storage + port->field->offset;
        const dds_sequence_t *sequence = place;
        if (!port->field->width && sequence->_length < port->width)
            return false;
        memcpy(message->values + port->offset, port->field->width ? place : sequence->_buffer,
               fl_type_size(port->field->type) * port->width);
    }
    message->stamp_ns = layout->type->header ? stamp->sec * INT64_C(1000000000) + stamp->nanosec : 0;
    return true;
}
