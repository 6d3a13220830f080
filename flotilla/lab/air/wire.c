/* QEMU plug-in: a computer on the cable of a guest in virtual time, which sends at its own rate, whatever the guest
 * does.
 *
 * `netdev=` is the cable, `frames=` a file with what is sent, one after the other, over and over: each with its length
 * before it, two bytes, least significant first. `interval_ns=` passes between two. What the adapter cannot take is
 * lost, as all is while it is down.
 *
 * Timers and cables are QEMU's own, which its program exports for its modules (include/qemu/timer.h,
 * include/net/net.h), those of QEMU 7.2, which is locked; barrier.c says why it begins as it does. */
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "plugin.h"

enum { BYTES = 1 << 20 };
struct cable;
struct cable *qemu_find_netdev(const char *name);
int qemu_can_send_packet(struct cable *cable);
long qemu_send_packet(struct cable *cable, const uint8_t *frame, int bytes);

static const char *netdev;
static uint8_t frames[BYTES];
static size_t bytes, next;
static int64_t interval_ns, at_ns;
static struct timer pause;

static void send_one(void *data)
{
    (void)data;
    size_t length = (size_t)(frames[next] | frames[next + 1] << 8);
    struct cable *cable = qemu_find_netdev(netdev);
    if (cable && qemu_can_send_packet(cable))
        qemu_send_packet(cable, frames + next + 2, (int)length);
    next += 2 + length;
    if (next >= bytes)
        next = 0;
    at_ns += interval_ns;
    timer_mod_ns(&pause, at_ns);
}

static void translated(qemu_plugin_id_t id, struct qemu_plugin_tb *block)
{
    (void)id;
    (void)block;
    if (at_ns)
        return;
    at_ns = interval_ns;
    timer_init_full(&pause, NULL, QEMU_CLOCK_VIRTUAL, SCALE_NS, 0, send_one, NULL);
    timer_mod_ns(&pause, at_ns);
}

int qemu_plugin_install(qemu_plugin_id_t id, const struct qemu_info *info, int count, char **arguments)
{
    (void)info;
    const char *path = argument("frames", count, arguments);
    FILE *file = fopen(path, "rbe");
    bytes = file ? fread(frames, 1, sizeof frames, file) : 0;
    if (file)
        fclose(file);
    netdev = strdup(argument("netdev", count, arguments)); /* the arguments are gone afterwards */
    interval_ns = strtoll(argument("interval_ns", count, arguments), NULL, 10);
    size_t end = 0;
    while (end + 2 < bytes)
        end += 2 + (size_t)(frames[end] | frames[end + 1] << 8);
    if (!bytes || end != bytes || !netdev || interval_ns <= 0) {
        fprintf(stderr, "%s: no frames, or no interval\n", path);
        return 1;
    }
    qemu_plugin_register_vcpu_tb_trans_cb(id, translated);
    return 0;
}
