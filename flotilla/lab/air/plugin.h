/* What plug-ins of QEMU begin with: a plug-in's own interface (include/qemu/qemu-plugin.h, version 1), and QEMU's
 * timers (include/qemu/timer.h), which its program exports for its modules. They are those of QEMU 7.2, which is
 * locked. */
#pragma once

#include <stdint.h>
#include <string.h>

#include "channel.h" /* EXPORT */

typedef uint64_t qemu_plugin_id_t;
struct qemu_info;
EXPORT int qemu_plugin_version = 1;
EXPORT int qemu_plugin_install(qemu_plugin_id_t id, const struct qemu_info *info, int count, char **arguments);
struct qemu_plugin_tb;
void qemu_plugin_register_vcpu_tb_trans_cb(qemu_plugin_id_t id,
                                           void (*translated)(qemu_plugin_id_t id, struct qemu_plugin_tb *block));

enum { QEMU_CLOCK_VIRTUAL = 1, SCALE_NS = 1 };
struct timer {
    int64_t members[8]; /* QEMUTimer has 48 bytes */
};
void timer_init_full(struct timer *timer, void *default_lists, int clock, int scale, int attributes,
                     void (*ends)(void *data), void *data);
void timer_mod_ns(struct timer *timer, int64_t at_ns);

/* The value of an argument `name=value`; "" where there is none. */
static const char *argument(const char *name, int count, char **arguments)
{
    size_t length = strlen(name);
    for (int i = 0; i < count; i++)
        if (!strncmp(arguments[i], name, length) && arguments[i][length] == '=')
            return arguments[i] + length + 1;
    return "";
}
