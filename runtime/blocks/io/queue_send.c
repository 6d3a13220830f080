/** queue-send
 *
 * Sends a signal to a queue-receive block in another task of this computer, once a step.
 *
 * Failure: No step waits. When the queue is full the oldest or the newest message is dropped, by `full`, and counted
 * in `dropped`. A queue that cannot be opened, or that another block sends to, fails the start.
 */
#include "queue.h"

#include <string.h>

struct queue_send {
    QUEUE_MEMBERS;
    int full;
};

enum full { DROP_OLDEST, DROP_NEWEST };

static const struct fl_parameter parameters[] = {
    QUEUE_PARAMETERS(struct queue_send),
    FL_PARAMETER(struct queue_send, full, .default_value = "drop-oldest", .choices = "drop-oldest|drop-newest",
                 .summary = "which message is dropped when the queue is full"),
};

static const struct fl_port outputs[] = {
    {.name = "sent", .type = FL_UINT32, .width = 1, .summary = "messages put into the queue so far"},
    {.name = "dropped",
     .type = FL_UINT32,
     .width = 1,
     .summary = "messages, of those before too, lost to a full queue"},
};

enum { DATA };
enum { SENT, DROPPED };

struct state {
    struct queue queue;
    uint32_t sequence;
};

static int configure(struct fl_block *block)
{
    const struct queue_send *send = block->parameters;
    if (queue_check_name(block, send->name) != FL_OK)
        return FL_FAILED;
    return fl_add_input(block, (struct fl_port){.name = "data",
                                                .type = (enum fl_type)send->type,
                                                .width = (uint32_t)send->width,
                                                .summary = "signal, sent each step"});
}

static int start(struct fl_block *block)
{
    const struct queue_send *send = block->parameters;
    struct state *state = block->state;
    return queue_open(&state->queue, block, QUEUE_SENDER, send->name, (enum fl_type)send->type, send->width,
                      send->depth);
}

static void fill(struct fl_block *block, struct state *state)
{
    struct queue_message *message = state->queue.message;
    message->sent_ns = fl_now_ns();
    message->sequence = state->sequence;
    message->type = (uint16_t)block->in_ports[DATA].type;
    message->width = (uint16_t)block->in_ports[DATA].width;
    memcpy(message->data, block->in[DATA], state->queue.data_bytes);
}

static int step(struct fl_block *block)
{
    const struct queue_send *send = block->parameters;
    struct state *state = block->state;
    state->sequence++;
    fill(block, state);
    bool put = queue_put(&state->queue);
    if (!put && send->full == DROP_OLDEST) {
        if (queue_take(&state->queue)) /* else the receiver was faster */
            FL_OUT(block, DROPPED, uint32_t)++;
        fill(block, state);
        put = queue_put(&state->queue);
    }
    if (put)
        FL_OUT(block, SENT, uint32_t)++;
    else
        FL_OUT(block, DROPPED, uint32_t)++;
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    queue_close(&state->queue);
}

FL_BLOCK(queue_send) = {
    .abi = FL_ABI,
    .name = "queue-send",
    .summary = "sends a signal each step to a queue-receive in another task of this computer: an input `data`",
    .source = "POSIX.1-2017, mq_send; Linux: mq_overview(7)",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct queue_send),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .terminate = terminate,
};
