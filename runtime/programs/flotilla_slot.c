/* flotilla-slot: which slot of the card runs, which starts next, and what the boot loader is told of it (boot_state.h).
 */
#define _GNU_SOURCE
#include "boot_state.h"

#include <errno.h>
#include <getopt.h>
#include <inttypes.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <time.h>

static const char usage[] =
    "usage: flotilla-slot [OPTION]... COMMAND [SLOT]\n"
    "\n"
    "  show        the slots, as one object of JSON\n"
    "  started     the running slot has started: it is good, unless it is on trial\n"
    "  confirm     the running slot is good, on trial or not, and is started first from now on\n"
    "  trial SLOT  the next start tries SLOT once; without `confirm`, the one after that takes the running slot again\n"
    "  clear SLOT  SLOT is empty from now on; not the running one\n"
    "  await       wait for as long as a trial takes, 600 s or the kernel's flotilla.trial_s=; status 1 if the\n"
    "              running slot is on trial then\n"
    "\n"
    "  --disk PATH     the card (default: the disk of the running root)\n"
    "  --running SLOT  (default: what the kernel's command line says)\n"
    "  --help, --version\n"
    "\n"
    "Status: 0 done, 1 refused or failed, 2 the command line is wrong.\n";

enum { DISK = 1, RUNNING, HELP, VERSION };
enum { TRIAL_S = 600 };

static const struct option options[] = {
    {"disk", required_argument, NULL, DISK},
    {"running", required_argument, NULL, RUNNING},
    {"help", no_argument, NULL, HELP},
    {"version", no_argument, NULL, VERSION},
    {0},
};

struct command {
    const char *name;
    bool takes_slot, waits;
    int (*run)(struct boot_card *card, struct boot_state *state, int running, int slot);
};

static int refuse(const char *reason)
{
    fprintf(stderr, "flotilla-slot: %s\n", reason);
    return 1;
}

static int slot_of(const char *name)
{
    return strcmp(name, "A") == 0 ? 0 : strcmp(name, "B") == 0 ? 1 : -1;
}

static char letter(int slot)
{
    return "AB"[slot];
}

static void print_text(const char *name, const char *value)
{
    if (!*value) {
        printf("\"%s\": null", name);
        return;
    }
    printf("\"%s\": \"", name);
    for (; *value; value++)
        if (*value >= ' ' && *value != '"' && *value != '\\' && *value < 127)
            putchar(*value);
    putchar('"');
}

static int show(struct boot_card *card, struct boot_state *state, int running, int slot)
{
    (void)slot;
    char name[] = {running >= 0 ? letter(running) : '\0', '\0'};
    char trial[] = {state->trial >= 0 ? letter(state->trial) : '\0', '\0'};
    putchar('{');
    print_text("running", name);
    printf(", \"sequence\": %" PRIu64 ", \"order\": [\"%c\", \"%c\"], ", state->sequence, letter(state->first),
           letter(!state->first));
    print_text("trial", trial);
    fputs(", \"slots\": {", stdout);
    for (int i = 0; i < BOOT_SLOTS; i++) {
        const struct boot_slot *each = &state->slots[i];
        printf("%s\"%c\": {\"ok\": %s, \"tries\": %u, ", i ? ", " : "", letter(i),
               each->good && each->there ? "true" : "false", each->tries);
        print_text("release", each->release);
        fputs(", ", stdout);
        print_text("floor", each->floor);
        fputs(", ", stdout);
        print_text("blob", each->blob);
        fputs(", ", stdout);
        print_text("kernel", each->kernel);
        printf(", \"start\": %" PRId64 ", \"size\": %" PRId64 "}", card->start[1 + i], card->size[1 + i]);
    }
    puts("}}");
    return fflush(stdout) == 0 ? 0 : refuse("standard output cannot be written");
}

/* Write the state, if it is another one or not on the card as it should be. */
static int keep(struct boot_card *card, const struct boot_state *before, struct boot_state *after)
{
    char reason[PATH_MAX + 200];
    bool counted = before->slots[0].tries || before->slots[1].tries;
    bool changed = before->first != after->first || before->trial != after->trial;
    for (int i = 0; i < BOOT_SLOTS; i++)
        changed |= before->slots[i].good != after->slots[i].good;
    if ((counted || changed || !card->same) && !boot_write(card, after, reason, sizeof reason))
        return refuse(reason);
    /* After the state: to lose the count of a trial before its end is written would try it again. */
    if (!card->tries_valid && !boot_repair_tries(card, reason, sizeof reason))
        return refuse(reason);
    return 0;
}

static int started(struct boot_card *card, struct boot_state *state, int running, int slot)
{
    (void)slot;
    struct boot_state after = *state;
    if (state->trial == running) {
        printf("slot %c is on trial\n", letter(running));
        return 0;
    }
    if (state->trial >= 0) { /* it was tried, and this one runs */
        printf("slot %c has failed its trial\n", letter(state->trial));
        after.slots[state->trial].good = false;
        after.trial = -1;
    }
    after.slots[running].good = true;
    if (state->slots[!running].tries >= BOOT_TRIES) {
        printf("slot %c has failed %d starts\n", letter(!running), BOOT_TRIES);
        after.slots[!running].good = false;
    }
    return keep(card, state, &after);
}

static int confirm(struct boot_card *card, struct boot_state *state, int running, int slot)
{
    (void)slot;
    struct boot_state after = *state;
    after.slots[running].good = true;
    after.first = running;
    after.trial = -1;
    return keep(card, state, &after);
}

static int try_slot(struct boot_card *card, struct boot_state *state, int running, int slot)
{
    struct boot_state after = *state;
    if (slot == running)
        return refuse("the running slot needs no trial");
    if (!state->slots[slot].there)
        return refuse("that slot is empty");
    after.trial = slot;
    after.first = running;
    after.slots[running].good = true;
    /* A count that the card cannot keep would make the boot loader pass over the trial. */
    return keep(card, state, &after);
}

static int clear(struct boot_card *card, struct boot_state *state, int running, int slot)
{
    char reason[PATH_MAX + 200];
    struct boot_state after = *state;
    if (slot == running)
        return refuse("the running slot cannot be cleared");
    after.slots[slot].good = false;
    after.first = running;
    if (after.trial == slot)
        after.trial = -1;
    int status = keep(card, state, &after);
    if (status == 0 && !boot_clear(card, slot, reason, sizeof reason))
        return refuse(reason);
    return status;
}

static int judge_trial(struct boot_card *card, struct boot_state *state, int running, int slot)
{
    (void)card;
    (void)slot;
    return state->trial == running ? refuse("nobody has confirmed the slot on trial") : 0;
}

static const struct command commands[] = {
    {.name = "show", .run = show},
    {.name = "started", .run = started},
    {.name = "confirm", .run = confirm},
    {.name = "trial", .takes_slot = true, .run = try_slot},
    {.name = "clear", .takes_slot = true, .run = clear},
    {.name = "await", .waits = true, .run = judge_trial},
};

/* What follows `key` on the kernel's command line, or NULL. */
static const char *argument_of_kernel(const char *key)
{
    static char words[4096];
    FILE *file = fopen("/proc/cmdline", "re");
    const char *found = file && fgets(words, sizeof words, file) ? strstr(words, key) : NULL;
    if (file)
        fclose(file);
    return found ? found + strlen(key) : NULL;
}

/* The slot that the boot loader says it has started, or -1. */
static int running_slot(void)
{
    const char *name = argument_of_kernel("flotilla.slot=");
    return !name ? -1 : *name == 'A' ? 0 : *name == 'B' ? 1 : -1;
}

/* The disk whose second or third partition is the root. */
static bool find_disk(char *path, size_t size)
{
    char line[1024], device[32] = "", name[64] = "";
    FILE *mounts = fopen("/proc/self/mountinfo", "re");
    while (mounts && fgets(line, sizeof line, mounts)) {
        char number[32], point[256];
        if (sscanf(line, "%*s %*s %31s %*s %255s", number, point) == 2 && strcmp(point, "/") == 0)
            snprintf(device, sizeof device, "%s", number); /* the last one mounted there */
    }
    if (mounts)
        fclose(mounts);
    snprintf(line, sizeof line, "/sys/dev/block/%s/uevent", device);
    FILE *events = fopen(line, "re");
    while (events && fgets(line, sizeof line, events))
        (void)!sscanf(line, "DEVNAME=%63s", name);
    if (events)
        fclose(events);
    size_t length = strlen(name);
    if (length < 2 || (name[length - 1] != '2' && name[length - 1] != '3'))
        return false;
    name[length - 1] = '\0';
    if (name[length - 2] == 'p' && length > 2 && name[length - 3] >= '0' && name[length - 3] <= '9')
        name[length - 2] = '\0'; /* mmcblk0p2 */
    snprintf(path, size, "/dev/%s", name);
    return true;
}

static void wait_for_a_trial(void)
{
    const char *seconds = argument_of_kernel("flotilla.trial_s=");
    struct timespec left = {.tv_sec = seconds ? strtol(seconds, NULL, 10) : TRIAL_S};
    while (clock_nanosleep(CLOCK_BOOTTIME, 0, &left, &left) == EINTR)
        ;
}

static int run(const struct command *command, const char *disk, int running, int slot)
{
    char reason[PATH_MAX + 200], usual[PATH_MAX];
    struct boot_card card;
    struct boot_state state;
    if (!disk && !find_disk(usual, sizeof usual))
        return refuse("the running root is on no card");
    if (!boot_open(&card, disk ? disk : usual, reason, sizeof reason))
        return refuse(reason);
    if (flock(card.fd, LOCK_EX) != 0)
        return refuse(strerror(errno));
    boot_read(&card, &state);
    return command->run(&card, &state, running, slot);
}

int main(int argc, char **argv)
{
    const char *disk = NULL;
    int running = running_slot();
    for (int option; (option = getopt_long(argc, argv, "+", options, NULL)) != -1;) {
        switch (option) {
        case DISK:
            disk = optarg;
            break;
        case RUNNING:
            running = slot_of(optarg);
            break;
        case HELP:
            fputs(usage, stdout);
            return 0;
        case VERSION:
            puts("flotilla-slot " FLOTILLA_VERSION);
            return 0;
        default:
            fputs(usage, stderr);
            return 2;
        }
    }
    for (size_t i = 0; optind < argc && i < sizeof commands / sizeof *commands; i++) {
        const struct command *each = &commands[i];
        if (strcmp(argv[optind], each->name) != 0 || argc != optind + 1 + each->takes_slot)
            continue;
        int slot = each->takes_slot ? slot_of(argv[optind + 1]) : 0;
        if (slot < 0)
            break;
        if (running < 0 && each->run != show)
            return refuse("no slot runs: the kernel's command line names none");
        if (each->waits)
            wait_for_a_trial();
        return run(each, disk, running, slot);
    }
    fputs(usage, stderr);
    return 2;
}
