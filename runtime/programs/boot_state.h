/* What boot loader and system tell each other about the slots, in raw sectors of the card; no file system is involved.
 *
 * Partition 1 has three regions of BOOT_REGION bytes, so that what flash loses beside a sector that it writes is
 * nothing of the others: region 0  a tar header, then the tries: written by the boot loader alone (by which GRUB finds
 * the sector to write) region 1  copy 0 of the state: written by the system alone region 2  copy 1 of the state:
 * written by the system alone Each block is one sector, in the form of GRUB's environment block (GRUB 2.06 manual, "The
 * GRUB environment block"). A state has a sequence number; the valid copy with the higher one counts. Tries count for
 * the state whose number they name. The last sectors of each slot hold its header; a slot without one is empty.
 * flotilla/images/card.py makes a new card, images/boot/grub.cfg.j2 is the other reader.
 */
#ifndef BOOT_STATE_H
#define BOOT_STATE_H

#include <stdbool.h>
#include <stdint.h>

enum {
    BOOT_SECTOR = 512,
    BOOT_HEADER = 1024, /* bytes of a slot's header */
    BOOT_SLOTS = 2,
    BOOT_COPIES = 2,
    BOOT_PARTITIONS = 3, /* state, slot A, slot B */
    BOOT_TRIES = 3,      /* of a good slot, until a state is written; one on trial has one */
};
#define BOOT_REGION      (INT64_C(4) << 20)
#define BOOT_HEADER_ROOM INT64_C(4096) /* before a slot's end: there its header begins */

struct boot_slot {
    bool good;        /* a system of it has confirmed that it works */
    bool there;       /* it has a header, so its content is whole */
    unsigned tries;   /* starts since the state was written */
    char release[24]; /* the header's fields; empty where there is none */
    char floor[24];
    char blob[72];
    char kernel[72];
};

struct boot_state {
    uint64_t sequence; /* 0: no copy is valid, the rest is the default */
    int first;         /* the slot that is started first, 0 is A */
    int trial;         /* the slot that is on trial, or -1 */
    struct boot_slot slots[BOOT_SLOTS];
};

struct boot_card {
    int fd;
    int64_t start[BOOT_PARTITIONS], size[BOOT_PARTITIONS]; /* bytes */
    uint64_t copies[BOOT_COPIES];                          /* sequence of each copy, 0: not valid */
    bool tries_valid;
    bool same; /* both copies say the same state */
};

/* Open the disk at `path` and find its partitions. On failure false, and `reason` says why. */
bool boot_open(struct boot_card *card, const char *path, char *reason, int size);

/* Read the state; what cannot be read is the default, as the boot loader takes it. */
void boot_read(struct boot_card *card, struct boot_state *state);

/* Write the state with the next sequence number: the older copy, which is read back, then the other. Power may go at
 * any time: one of them is always valid. Tries count anew. On failure false, and `reason` says why. */
bool boot_write(struct boot_card *card, struct boot_state *state, char *reason, int size);

/* Write the block of tries anew where it is none. */
bool boot_repair_tries(struct boot_card *card, char *reason, int size);

/* Clear the header of a slot: from now on the slot is empty. */
bool boot_clear(struct boot_card *card, int slot, char *reason, int size);

#endif
