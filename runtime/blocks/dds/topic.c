#include "topic.h"

#include "flotilla.h"

#include <stdio.h>
#include <stdlib.h>
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

struct dds_topic dds_topic(const struct dds_settings *settings)
{
    return (struct dds_topic){
        .type = types[settings->type].descriptor,
        .name = settings->topic,
        .domain = (uint32_t)settings->domain,
        .reliable = settings->reliability,
        .deadline = settings->deadline,
    };
}

static void name_partition(char name[DDS_PARTITION_BYTES], uint16_t robot)
{
    snprintf(name, DDS_PARTITION_BYTES, "robot%u", (unsigned)robot);
}

void dds_enter_partition(struct dds_topic *topic, const struct dds_settings *settings, uint16_t robot)
{
    if (settings->partition == DDS_ROBOTS_PARTITION)
        name_partition(topic->partitions[topic->partition_count++], robot);
}

int dds_robot_of_partition(dds_entity_t reader, dds_instance_handle_t writer)
{
    static const char prefix[] = "robot";
    uint32_t count = 0;
    char **names = NULL, expected[DDS_PARTITION_BYTES];
    int robot = -1;
    dds_builtintopic_endpoint_t *publication = dds_get_matched_publication_data(reader, writer);
    if (!publication)
        return -1;
    if (dds_qget_partition(publication->qos, &count, &names) && count == 1 &&
        strncmp(names[0], prefix, strlen(prefix)) == 0) {
        robot = (uint16_t)strtoul(names[0] + strlen(prefix), NULL, 10);
        name_partition(expected, (uint16_t)robot);
        if (strcmp(names[0], expected) != 0)
            robot = -1;
    }
    for (uint32_t i = 0; i < count; i++)
        dds_free(names[i]);
    dds_free(names);
    dds_builtintopic_free_endpoint(publication);
    return robot;
}

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
