/** queue-receive
 *
 * Receives the signal of a queue-send block in another task of this computer. `age` counts from when it was sent.
 *
 * Failure: The flag is 0 once the newest message is older than `timeout`. While the flag is 0 the values stay the last
 * good ones, and `age` grows. Messages of another type or width are counted in `refused`, those missing in the
 * sender's count in `dropped`. A queue that cannot be opened, or that another block receives from, fails the start.
 */
#include "queue.h"

#include <flotilla/sensor.h>
#include <string.h>

struct queue_receive {
    QUEUE_MEMBERS;
    int take;
    double timeout;
};

enum take { NEWEST, IN_ORDER };

static const struct fl_parameter parameters[] = {
    QUEUE_PARAMETERS(struct queue_receive),
    FL_PARAMETER(struct queue_receive, take, .default_value = "newest", .choices = "newest|in-order",
                 .summary = "each step takes the newest message, or the next one that waits"),
    FL_SENSOR_TIMEOUT(struct queue_receive, "0.1"),
};

static const struct fl_port outputs[] = {
    FL_SENSOR_OUTPUTS,
    {.name = "dropped", .type = FL_UINT32, .width = 1, .summary = "messages missing in the sender's count"},
    {.name = "refused",
     .type = FL_UINT32,
     .width = 1,
     .flags = FL_REFUSALS,
     .summary = "messages of another type or width"},
};

enum { FLAG, AGE, SEQUENCE, DROPPED, REFUSED, DATA };

struct state {
    struct queue queue;
    struct fl_sensor sensor;
    uint32_t last; /* the sender's count; 0: none */
};

static int configure(struct fl_block *block)
{
    const struct queue_receive *receive = block->parameters;
    if (queue_check_name(block, receive->name) != FL_OK)
        return FL_FAILED;
    return fl_add_output(block, (struct fl_port){.name = "data",
                                                 .type = (enum fl_type)receive->type,
                                                 .width = (uint32_t)receive->width,
                                                 .summary = "signal of the last message taken"});
}

static int start(struct fl_block *block)
{
    const struct queue_receive *receive = block->parameters;
    struct state *state = block->state;
    fl_sensor_begin(&state->sensor);
    if (queue_open(&state->queue, block, QUEUE_RECEIVER, receive->name, (enum fl_type)receive->type, receive->width,
                   receive->depth) != FL_OK)
        return FL_FAILED;
    for (int64_t i = 0; i < receive->depth && queue_take(&state->queue); i++)
        ; /* waiting messages may be from a task that ended long ago */
    return FL_OK;
}

static void accept(struct fl_block *block, struct state *state)
{
    const struct queue_message *message = state->queue.message;
    if (message->type != block->out_ports[DATA].type || message->width != block->out_ports[DATA].width) {
        FL_OUT(block, REFUSED, uint32_t)++;
        return;
    }
    /* A count that did not increase is from a sender that has restarted. */
    if (state->last && message->sequence > state->last)
        FL_OUT(block, DROPPED, uint32_t) += message->sequence - state->last - 1;
    state->last = message->sequence;
    memcpy(block->out[DATA], message->data, state->queue.data_bytes);
    fl_sensor_update(&state->sensor, message->sent_ns, state->sensor.sequence + 1);
}

static int step(struct fl_block *block)
{
    const struct queue_receive *receive = block->parameters;
    struct state *state = block->state;
    int64_t most = receive->take == IN_ORDER ? 1 : receive->depth;
    for (int64_t i = 0; i < most && queue_take(&state->queue); i++)
        accept(block, state);
    fl_sensor_outputs(&state->sensor, block, FLAG, true, receive->timeout);
    return FL_OK;
}

static void terminate(struct fl_block *block)
{
    struct state *state = block->state;
    queue_close(&state->queue);
}

FL_BLOCK(queue_receive) = {
    .abi = FL_ABI,
    .name = "queue-receive",
    .summary = "receives a signal from a queue-send in another task of this computer: an output `data`",
    .source = "POSIX.1-2017, mq_receive; Linux: mq_overview(7)",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct queue_receive),
    .state_size = sizeof(struct state),
    .configure = configure,
    .start = start,
    .step = step,
    .terminate = terminate,
};
