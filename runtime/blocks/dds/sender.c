#define _GNU_SOURCE
#include "sender.h"

#include <errno.h>
#include <math.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

const struct fl_port dds_sender_inputs[] = {
    {.name = "withhold", .type = FL_BOOLEAN, .width = 1, .flags = FL_OPTIONAL, .summary = "1: nothing is published"},
    {.name = "sequence",
     .type = FL_UINT32,
     .width = 1,
     .flags = FL_OPTIONAL,
     .summary = "sequence of the input that the data are made from: publish only when it has changed"},
};

const struct fl_port dds_sender_outputs[] = {
    {.name = "peers", .type = FL_UINT32, .width = 1, .summary = "subscribers that are known now"},
    {.name = "written", .type = FL_UINT32, .width = 1, .summary = "samples that DDS took"},
};

static void matched(dds_entity_t writer, const dds_publication_matched_status_t status, void *context)
{
    struct dds_sender *sender = context;
    (void)writer;
    atomic_store(&sender->peers, status.current_count);
}

/* Write the newest waiting sample. Older ones are useless, as is one that waited too long for DDS, or in a stopped
 * process. */
static void write_newest(struct dds_sender *sender, dds_entity_t writer)
{
    char tokens[64];
    while (recv(sender->wake[1], tokens, sizeof tokens, MSG_DONTWAIT) > 0)
        ;
    const void *sample = newest_take(&sender->samples);
    if (!sample || fl_now_ns() - *(const int64_t *)sample > llround(sender->topic.lifespan * 1e9))
        return;
    sender->encode(sender->block, sample, sender->storage);
    if (dds_write(writer, sender->storage) == DDS_RETCODE_OK)
        atomic_fetch_add(&sender->written, 1);
}

static void set_listener(dds_listener_t *listener)
{
    dds_lset_publication_matched(listener, matched);
}

/* A best-effort writer keeps no sample, and so no instance. DDS would create the instance for each sample, and its
 * garbage collector, at the same priority, remove it again. A registered instance stays until the participant is
 * deleted. */
static void keep_instance(struct dds_sender *sender, dds_entity_t writer)
{
    dds_instance_handle_t handle;
    sender->encode(sender->block, sender->first, sender->storage);
    dds_return_t registered = dds_register_instance(writer, &handle, sender->storage);
    if (registered != DDS_RETCODE_OK)
        fl_warn(sender->block, "topic %s: instance: %s", sender->topic.name, dds_strretcode(registered));
}

static void serve(void *context, struct fl_driver *driver, dds_entity_t writer)
{
    struct dds_sender *sender = context;
    keep_instance(sender, writer);
    while (fl_driver_wait(driver, sender->wake[1], false, -1) == 1)
        write_newest(sender, writer);
}

static void run(struct fl_driver *driver, void *context)
{
    static const struct dds_endpoint endpoint = {dds_create_writer, set_listener, serve};
    struct dds_sender *sender = context;
    dds_run(&endpoint, &sender->topic, sender->block, driver, sender);
}

int dds_sender_start(struct dds_sender *sender, struct fl_block *block, const void *first)
{
    sender->block = block;
    sender->first = fl_allocate(block, sender->sample_bytes);
    sender->storage = fl_allocate(block, sender->storage_bytes);
    if (!sender->first || !sender->storage || newest_allocate(&sender->samples, block, sender->sample_bytes) != FL_OK)
        return FL_FAILED;
    memcpy(sender->first, first, sender->sample_bytes);
    if (socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, sender->wake) < 0)
        return fl_fail(block, "socketpair: %s", strerror(errno));
    sender->driver = fl_driver_start(block, run, sender);
    return sender->driver ? FL_OK : FL_FAILED;
}

void *dds_sender_begin(struct dds_sender *sender)
{
    uint32_t before = sender->sequence;
    sender->sequence = FL_IN(sender->block, DDS_SEQUENCE, uint32_t);
    if (FL_IN(sender->block, DDS_WITHHOLD, uint8_t) || (before && before == sender->sequence))
        return NULL;
    void *made = newest_back(&sender->samples);
    *(int64_t *)made = fl_now_ns();
    return made;
}

void dds_sender_end(struct dds_sender *sender, const void *made)
{
    if (made) {
        newest_put(&sender->samples);
        send(sender->wake[0], "", 1, MSG_DONTWAIT | MSG_NOSIGNAL);
    }
    FL_OUT(sender->block, DDS_PEERS, uint32_t) = atomic_load(&sender->peers);
    FL_OUT(sender->block, DDS_WRITTEN, uint32_t) = atomic_load(&sender->written);
}

void dds_sender_stop(struct dds_sender *sender)
{
    fl_driver_stop(sender->driver);
    for (int i = 0; i < 2; i++)
        if (sender->wake[i] > 0)
            close(sender->wake[i]);
}
