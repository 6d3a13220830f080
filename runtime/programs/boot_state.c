#define _GNU_SOURCE
#include "boot_state.h"

#include <endian.h>
#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define SIGNATURE "# GRUB Environment Block\n"
#define ALIGNED   __attribute__((aligned(4096)))

enum {
    MBR_TABLE = 446,
    MBR_ENTRY = 16,
    MBR_GPT = 0xee,  /* type of the one partition that protects a GPT */
    GPT_ENTRY = 128, /* UEFI specification 2.10, tables 5.5 and 5.6 */
    TAR_CHECKSUM = 148,
};

static const char slot_names[] = "AB";

__attribute__((format(printf, 3, 4))) static bool fail(char *reason, int size, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(reason, (size_t)size, format, arguments);
    va_end(arguments);
    return false;
}

/* Reads and writes go past the page cache: what is read back comes from the card. */
static bool read_sectors(const struct boot_card *card, int64_t offset, void *buffer, int length)
{
    return pread(card->fd, buffer, (size_t)length, offset) == length;
}

static bool write_sectors(const struct boot_card *card, int64_t offset, const void *content, int length, char *reason,
                          int size)
{
    char again[BOOT_HEADER] ALIGNED, aligned[BOOT_HEADER] ALIGNED;
    memcpy(aligned, content, (size_t)length);
    if (pwrite(card->fd, aligned, (size_t)length, offset) != length || fdatasync(card->fd) != 0)
        return fail(reason, size, "byte %" PRId64 " of the card cannot be written: %s", offset, strerror(errno));
    if (!read_sectors(card, offset, again, length) || memcmp(again, aligned, (size_t)length) != 0)
        return fail(reason, size, "byte %" PRId64 " of the card does not keep what is written to it", offset);
    return true;
}

/* Where the partitions lie; false where the sectors hold no table. */
static bool read_partitions(struct boot_card *card)
{
    unsigned char sectors[3 * BOOT_SECTOR] ALIGNED, *mbr = sectors, *header = sectors + BOOT_SECTOR;
    if (!read_sectors(card, 0, sectors, sizeof sectors) || mbr[510] != 0x55 || mbr[511] != 0xaa)
        return false;
    bool gpt = mbr[MBR_TABLE + 4] == MBR_GPT;
    /* GRUB looks no further either, and where it found its state, this must. */
    if (gpt && memcmp(header, "EFI PART", 8) != 0)
        return false;
    for (int i = 0; i < BOOT_PARTITIONS; i++) {
        if (gpt) {
            uint64_t lbas[2]; /* first and last */
            memcpy(lbas, header + BOOT_SECTOR + (size_t)i * GPT_ENTRY + 32, sizeof lbas);
            for (int end = 0; end < 2; end++)
                lbas[end] = le64toh(lbas[end]);
            if (lbas[1] >= INT64_MAX / BOOT_SECTOR || lbas[0] > lbas[1])
                return false;
            card->start[i] = (int64_t)lbas[0] * BOOT_SECTOR;
            card->size[i] = (int64_t)(lbas[1] + 1 - lbas[0]) * BOOT_SECTOR;
        } else {
            uint32_t words[2]; /* first and number */
            memcpy(words, mbr + MBR_TABLE + (size_t)i * MBR_ENTRY + 8, sizeof words);
            card->start[i] = (int64_t)le32toh(words[0]) * BOOT_SECTOR;
            card->size[i] = (int64_t)le32toh(words[1]) * BOOT_SECTOR;
        }
    }
    return true;
}

bool boot_open(struct boot_card *card, const char *path, char *reason, int size)
{
    *card = (struct boot_card){.fd = open(path, O_RDWR | O_CLOEXEC | O_DIRECT)};
    if (card->fd < 0 && errno == EINVAL) /* a file system that knows no direct access */
        card->fd = open(path, O_RDWR | O_CLOEXEC);
    if (card->fd < 0)
        return fail(reason, size, "%s: %s", path, strerror(errno));
    if (!read_partitions(card))
        return fail(reason, size, "%s has no partition table of a card", path);
    if (card->size[0] < (1 + BOOT_COPIES) * BOOT_REGION)
        return fail(reason, size, "%s has another layout: its first partition holds no boot state", path);
    return true;
}

/* The value of a name in an environment block, or false. Such a value is one line. */
static bool value_of(const char *block, int length, const char *name, char *value, size_t size)
{
    size_t wanted = strlen(name);
    const char *end = block + length;
    value[0] = '\0';
    for (const char *line = block; line < end;) {
        const char *newline = memchr(line, '\n', (size_t)(end - line));
        if (!newline)
            return false;
        size_t rest = (size_t)(newline - line);
        if (rest > wanted && strncmp(line, name, wanted) == 0 && line[wanted] == '=' && rest - wanted - 1 < size) {
            memcpy(value, line + wanted + 1, rest - wanted - 1);
            value[rest - wanted - 1] = '\0';
            return true;
        }
        line = newline + 1;
    }
    return false;
}

static bool number_of(const char *block, int length, const char *name, uint64_t *number)
{
    char text[24], *end;
    if (!value_of(block, length, name, text, sizeof text) || text[0] < '0' || text[0] > '9')
        return false;
    errno = 0;
    *number = strtoull(text, &end, 10);
    return !*end && errno == 0;
}

static bool is_block(const char *block)
{
    return memcmp(block, SIGNATURE, sizeof SIGNATURE - 1) == 0;
}

/* CRC-32 of IEEE 802.3. */
static uint32_t crc_of(const char *bytes, size_t length)
{
    uint32_t crc = UINT32_MAX;
    for (size_t i = 0; i < length; i++) {
        crc ^= (unsigned char)bytes[i];
        for (int bit = 0; bit < 8; bit++)
            crc = crc >> 1 ^ (crc & 1 ? UINT32_C(0xedb88320) : 0);
    }
    return ~crc;
}

static void fill_block(char *block, size_t length, const char *text)
{
    int written = snprintf(block, length, SIGNATURE "%s", text);
    memset(block + written, '#', length - (size_t)written);
}

/* The lines that the check sum covers. */
static int body_of(const struct boot_state *state, char *text, size_t size)
{
    return snprintf(text, size, "SEQ=%" PRIu64 "\nORDER=%c %c\nA_OK=%d\nB_OK=%d\nTRIAL=%.1s\n", state->sequence,
                    slot_names[state->first], slot_names[!state->first], state->slots[0].good, state->slots[1].good,
                    state->trial >= 0 ? &slot_names[state->trial] : "");
}

static void make_copy(const struct boot_state *state, char *block)
{
    char text[BOOT_SECTOR - sizeof SIGNATURE];
    size_t length = (size_t)body_of(state, text, sizeof text);
    uint32_t crc = crc_of(text, length);
    snprintf(text + length, sizeof text - length, "CRC=%08" PRIx32 "\nEND=%" PRIu64 "\n", crc, state->sequence);
    fill_block(block, BOOT_SECTOR, text);
}

/* The state that a copy says: valid only when it is, byte for byte, what would be written of it. */
static bool parse_copy(const char *block, struct boot_state *state)
{
    char again[BOOT_SECTOR], text[8];
    uint64_t good[BOOT_SLOTS];
    *state = (struct boot_state){.trial = -1};
    if (!is_block(block) || !number_of(block, BOOT_SECTOR, "SEQ", &state->sequence) || !state->sequence ||
        !number_of(block, BOOT_SECTOR, "A_OK", &good[0]) || !number_of(block, BOOT_SECTOR, "B_OK", &good[1]) ||
        !value_of(block, BOOT_SECTOR, "ORDER", text, sizeof text))
        return false;
    state->first = text[0] == slot_names[1];
    for (int i = 0; i < BOOT_SLOTS; i++)
        state->slots[i].good = good[i] == 1;
    if (value_of(block, BOOT_SECTOR, "TRIAL", text, sizeof text) && text[0])
        state->trial = text[0] == slot_names[1];
    make_copy(state, again);
    return memcmp(block, again, BOOT_SECTOR) == 0;
}

static int64_t copy_place(const struct boot_card *card, int copy)
{
    return card->start[0] + (1 + copy) * BOOT_REGION;
}

static int64_t header_place(const struct boot_card *card, int slot)
{
    return card->start[1 + slot] + card->size[1 + slot] - BOOT_HEADER_ROOM;
}

/* Of a file `tries` of one sector (POSIX.1-1988, ustar). */
static void make_tar_header(char *header)
{
    static const struct field {
        int place;
        const char *text;
    } fields[] = {{0, "tries"},         {100, "0000644"},     {108, "0000000"},           {116, "0000000"},
                  {124, "00000001000"}, {136, "00000000000"}, {TAR_CHECKSUM, "        "}, {156, "0"},
                  {257, "ustar"},       {263, "00"}};
    unsigned sum = 0;
    memset(header, 0, BOOT_SECTOR);
    for (size_t i = 0; i < sizeof fields / sizeof *fields; i++)
        memcpy(header + fields[i].place, fields[i].text, strlen(fields[i].text));
    for (int i = 0; i < BOOT_SECTOR; i++)
        sum += (unsigned char)header[i];
    snprintf(header + TAR_CHECKSUM, 8, "%06o", sum & 0777777);
}

static void read_tries(struct boot_card *card, struct boot_state *state)
{
    char sectors[2 * BOOT_SECTOR] ALIGNED, header[BOOT_SECTOR];
    const char *block = sectors + BOOT_SECTOR;
    static const char *const names[] = {"A_TRIES", "B_TRIES"};
    uint64_t sequence, tries;
    make_tar_header(header);
    card->tries_valid = read_sectors(card, card->start[0], sectors, sizeof sectors) &&
                        memcmp(sectors, header, BOOT_SECTOR) == 0 && is_block(block);
    if (!card->tries_valid || !number_of(block, BOOT_SECTOR, "FOR", &sequence) || sequence != state->sequence)
        return;
    for (int i = 0; i < BOOT_SLOTS; i++)
        if (number_of(block, BOOT_SECTOR, names[i], &tries) && tries <= BOOT_TRIES)
            state->slots[i].tries = (unsigned)tries;
}

static void read_header(const struct boot_card *card, int slot, struct boot_slot *found)
{
    char block[BOOT_HEADER] ALIGNED;
    if (!read_sectors(card, header_place(card, slot), block, BOOT_HEADER) || !is_block(block))
        return;
    found->there = value_of(block, BOOT_HEADER, "RELEASE", found->release, sizeof found->release);
    value_of(block, BOOT_HEADER, "FLOOR", found->floor, sizeof found->floor);
    value_of(block, BOOT_HEADER, "BLOB", found->blob, sizeof found->blob);
    value_of(block, BOOT_HEADER, "VERSION", found->kernel, sizeof found->kernel);
}

void boot_read(struct boot_card *card, struct boot_state *state)
{
    char blocks[BOOT_COPIES][BOOT_SECTOR] ALIGNED;
    *state = (struct boot_state){.trial = -1, .slots = {{.good = true}, {.good = true}}};
    for (int i = 0; i < BOOT_COPIES; i++) {
        struct boot_state copy = {0};
        bool valid = read_sectors(card, copy_place(card, i), blocks[i], BOOT_SECTOR) && parse_copy(blocks[i], &copy);
        card->copies[i] = valid ? copy.sequence : 0;
        if (valid && copy.sequence > state->sequence)
            *state = copy;
    }
    card->same =
        card->copies[0] && card->copies[0] == card->copies[1] && memcmp(blocks[0], blocks[1], BOOT_SECTOR) == 0;
    read_tries(card, state);
    for (int i = 0; i < BOOT_SLOTS; i++)
        read_header(card, i, &state->slots[i]);
}

bool boot_write(struct boot_card *card, struct boot_state *state, char *reason, int size)
{
    char block[BOOT_SECTOR];
    int older = card->copies[0] > card->copies[1];
    state->sequence++;
    make_copy(state, block);
    for (int i = 0; i < BOOT_COPIES; i++) {
        int copy = i ? !older : older;
        if (!write_sectors(card, copy_place(card, copy), block, BOOT_SECTOR, reason, size))
            return false;
        card->copies[copy] = state->sequence;
    }
    return true;
}

bool boot_repair_tries(struct boot_card *card, char *reason, int size)
{
    char sectors[2 * BOOT_SECTOR];
    make_tar_header(sectors);
    fill_block(sectors + BOOT_SECTOR, BOOT_SECTOR, "FOR=0\n");
    return write_sectors(card, card->start[0], sectors, sizeof sectors, reason, size);
}

bool boot_clear(struct boot_card *card, int slot, char *reason, int size)
{
    char nothing[BOOT_HEADER] ALIGNED;
    fill_block(nothing, sizeof nothing, ""); /* a block, so that the boot loader reports no error */
    return write_sectors(card, header_place(card, slot), nothing, BOOT_HEADER, reason, size);
}
