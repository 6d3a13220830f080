/* QEMU plug-in: at the end of each quantum of virtual time the guest stands still, until the conductor lets it go on.
 * `mailbox=` is a file, `bell=` a chardev: a byte from there tells the guest that it has mail.
 *
 * A plug-in's own interface (include/qemu/qemu-plugin.h, version 1) tells it when instructions are translated, and
 * nothing of virtual time. Timers and chardevs are QEMU's own, which its program exports for its modules
 * (include/qemu/timer.h, include/chardev/char.h). Both are those of QEMU 7.2, which is locked. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <linux/futex.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "lockstep.h"
#include "plugin.h"

struct chardev;
struct chardev *qemu_chr_find(const char *name);
int qemu_chr_be_can_write(struct chardev *chardev);
void qemu_chr_be_write(struct chardev *chardev, const uint8_t *bytes, int count);

static struct mailbox *mailbox;
static const char *bell;
static struct timer quantum;

static void quantum_ends(void *data)
{
    (void)data;
    atomic_store(&mailbox->waits, 1);
    syscall(SYS_futex, &mailbox->waits, FUTEX_WAKE, 1, NULL, NULL, 0);
    while (atomic_load(&mailbox->waits))
        syscall(SYS_futex, &mailbox->waits, FUTEX_WAIT, 1, NULL, NULL, 0);
    struct chardev *chardev = qemu_chr_find(bell);
    const struct message *mail = first(&mailbox->in);
    if ((mailbox->ended || (mail && mail->at_ns < mailbox->next_ns)) && qemu_chr_be_can_write(chardev) > 0)
        qemu_chr_be_write(chardev, (const uint8_t *)"!", 1);
    if (!mailbox->ended)
        timer_mod_ns(&quantum, mailbox->next_ns);
}

/* The processor runs its first instructions: before that, nobody can be told of a timer. */
static void translated(qemu_plugin_id_t id, struct qemu_plugin_tb *block)
{
    (void)id;
    (void)block;
    static bool begun;
    if (begun)
        return;
    begun = true;
    timer_init_full(&quantum, NULL, QEMU_CLOCK_VIRTUAL, SCALE_NS, 0, quantum_ends, NULL);
    timer_mod_ns(&quantum, LONG_QUANTUM_NS);
}

int qemu_plugin_install(qemu_plugin_id_t id, const struct qemu_info *info, int count, char **arguments)
{
    (void)info;
    const char *file = argument("mailbox", count, arguments);
    bell = strdup(argument("bell", count, arguments)); /* the arguments are gone afterwards */
    int descriptor = open(file, O_RDWR | O_CLOEXEC);
    void *shared = mmap(NULL, MAILBOX_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, descriptor, 0);
    if (shared == MAP_FAILED || !bell) {
        fprintf(stderr, "the mailbox %s: %s\n", file, strerror(errno));
        return 1;
    }
    close(descriptor);
    mailbox = shared;
    qemu_plugin_register_vcpu_tb_trans_cb(id, translated);
    return 0;
}
