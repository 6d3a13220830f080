/* Message queues between the tasks of one computer: POSIX message queues (mq_overview(7)), without waiting.
 *
 * A queue has one sender and one receiver; the first to start creates it, the last to terminate removes it. A queue
 * that a killed task left behind is used again, or created again if its messages are of another size. Messages that
 * waited before the receiver started are dropped. A queue of another size that a running task uses is an error.
 */
#ifndef FLOTILLA_IO_QUEUE_H
#define FLOTILLA_IO_QUEUE_H

#include <flotilla/block.h>
#include <mqueue.h>

/* Members and parameters of both ends, which must agree. */
#define QUEUE_MEMBERS                                                                                                  \
    const char *name;                                                                                                  \
    int type;                                                                                                          \
    int64_t width;                                                                                                     \
    int64_t depth

#define QUEUE_PARAMETERS(block_type)                                                                                   \
    FL_PARAMETER(block_type, name, .summary = "the queue's, the same at both ends, such as /heading"),                 \
        FL_PARAMETER(block_type, type, .default_value = "double",                                                      \
                     .choices = "boolean|int8|uint8|int16|uint16|int32|uint32|int64|uint64|single|double",             \
                     .summary = "type of the signal"),                                                                 \
        FL_PARAMETER(block_type, width, .default_value = "1", .min = 1, .max = 1000,                                   \
                     .summary = "elements of the signal"),                                                             \
        FL_PARAMETER(block_type, depth, .default_value = "10", .min = 1, .max = 1000,                                  \
                     .summary = "messages that it holds; more than 10 need a higher fs.mqueue.msg_max")

/* A message, the same for tasks of 32 and 64 bits. */
struct queue_message {
    int64_t sent_ns;   /* CLOCK_MONOTONIC, which all tasks share */
    uint32_t sequence; /* counts the sender's messages, lost ones too, from 1 */
    uint16_t type, width;
    unsigned char data[];
};
_Static_assert(sizeof(struct queue_message) == 16, "both sides of 32 and 64 bits read it");

struct queue {
    bool open;
    mqd_t descriptor;
    const char *name;
    size_t data_bytes, message_bytes;
    struct queue_message *message; /* room for one */
};

enum queue_end { QUEUE_SENDER, QUEUE_RECEIVER };

/* For `configure`: check the name of a queue. */
int queue_check_name(struct fl_block *block, const char *name);

/* For start. FL_OK or FL_FAILED. */
int queue_open(struct queue *queue, struct fl_block *block, enum queue_end end, const char *name, enum fl_type type,
               int64_t width, int64_t depth);

/* Put queue->message in; false when there is no room. For the step. */
bool queue_put(struct queue *queue);

/* For the step: take the oldest message into queue->message; false when there is none. A message of another length, so
 * not of a queue-send, has the type FL_TYPES. */
bool queue_take(struct queue *queue);

/* For terminate. */
void queue_close(struct queue *queue);

#endif
