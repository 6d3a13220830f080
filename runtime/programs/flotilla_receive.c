/* flotilla-receive: a file that a station sends to all robots at once, by multicast with forward error correction.
 *
 * flotilla/updates/multicast.py sends, and describes the datagrams. A block's symbols go to their place in FILE.part,
 * repair symbols to FILE.repair, until a block has enough of both: memory holds one block at a time. What was received
 * is known again after a restart by the blocks' checksums; symbols of incomplete blocks are lost then. */
#define _GNU_SOURCE
#include "repair.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <getopt.h>
#include <inttypes.h>
#include <limits.h>
#include <nettle/base16.h>
#include <nettle/hmac.h>
#include <nettle/memops.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

static const char usage[] =
    "usage: flotilla-receive [OPTION]... --from ADDRESS --at ADDRESS --key KEY DESCRIPTION FILE\n"
    "Receive FILE, which a station sends to all robots at once. DESCRIPTION is what the station says of it.\n"
    "\n"
    "  --from ADDRESS   the station; datagrams of others are ignored\n"
    "  --at ADDRESS     this robot's address: by it the station asks, and it names the interface\n"
    "  --key KEY        file with the key of this transfer, 64 hexadecimal digits: by it datagrams are authenticated\n"
    "  --group ADDRESS  multicast group (default: 239.255.42.42)\n"
    "  --port PORT      UDP port (default: 4242)\n"
    "  --idle SECONDS   give up after so long without a datagram (default: 600)\n"
    "  --help, --version\n"
    "\n"
    "A call with the same FILE continues. FILE exists when it is whole: then the call prints `whole`, and still "
    "answers\n"
    "the station until that ends, or sends nothing more.\n"
    "Status: 0 FILE is whole, 1 an error of the system, 2 the command line, KEY or DESCRIPTION is wrong, 3 FILE is "
    "incomplete.\n";

enum { FROM = 1, AT, KEY, GROUP, PORT, IDLE, HELP, VERSION };

static const struct option options[] = {
    {"from", required_argument, NULL, FROM},
    {"at", required_argument, NULL, AT},
    {"key", required_argument, NULL, KEY},
    {"group", required_argument, NULL, GROUP},
    {"port", required_argument, NULL, PORT},
    {"idle", required_argument, NULL, IDLE},
    {"help", no_argument, NULL, HELP},
    {"version", no_argument, NULL, VERSION},
    {0},
};

enum {
    TAG = 8,          /* of HMAC-SHA-256 over the transfer's number (32 bit) and all that follows the tag */
    HEADER = TAG + 4, /* tag; block, symbol (16 bit each); all numbers are big-endian */
    KEY_BYTES = 32,
    END = 0xfffd,        /* instead of a block's number: the station ends */
    ANSWER = 0xfffe,     /* what a robot lacks */
    QUESTION = 0xffff,   /* what do you lack? */
    BLOCKS = 4096,       /* at most: 4 GiB */
    SLOT_MS = 20,        /* between the answers of two robots */
    ANSWER_BLOCKS = 120, /* in one answer */
    RECEIVE_BYTES = 1 << 20,
    NONE = -1,
};

/* A repair symbol in FILE.repair. */
struct stored {
    uint16_t number;
    int next; /* of the same block, or of those that are free */
};

struct block {
    bool whole;
    uint32_t checksum; /* CRC-32 of its bytes */
    unsigned have;     /* symbols, without duplicates */
    unsigned goal;     /* symbols at which a repair is worth trying */
    int repairs;       /* first of them */
};

struct transfer {
    uint32_t number;
    uint64_t size;
    unsigned count, whole; /* blocks */
    struct block blocks[BLOCKS];
    uint64_t present[BLOCKS][WORDS];
    struct stored *stored;
    int stored_count, unused;
    uint32_t received; /* datagrams with symbols, of any kind */
    uint8_t buffer[BLOCK_SYMBOLS * SYMBOL];
    int part, repairs; /* descriptors */
    char part_name[PATH_MAX], repairs_name[PATH_MAX];
    const char *name;
};

static int fail(const char *what)
{
    fprintf(stderr, "flotilla-receive: %s: %s\n", what, strerror(errno));
    return 1;
}

/* CRC-32 of IEEE 802.3. */
static uint32_t checksum(const uint8_t *bytes, size_t length)
{
    static uint32_t table[256];
    if (!table[1])
        for (uint32_t n = 0; n < 256; n++) {
            uint32_t value = n;
            for (int step = 0; step < 8; step++)
                value = value >> 1 ^ (value & 1 ? UINT32_C(0xedb88320) : 0);
            table[n] = value;
        }
    uint32_t sum = UINT32_MAX;
    while (length--)
        sum = sum >> 8 ^ table[(sum ^ *bytes++) & 0xff];
    return ~sum;
}

static size_t block_bytes(const struct transfer *transfer, unsigned block)
{
    uint64_t left = transfer->size - (uint64_t)block * BLOCK_SYMBOLS * SYMBOL;
    return left < BLOCK_SYMBOLS * SYMBOL ? (size_t)left : BLOCK_SYMBOLS * SYMBOL;
}

static unsigned block_symbols(const struct transfer *transfer, unsigned block)
{
    return (unsigned)((block_bytes(transfer, block) + SYMBOL - 1) / SYMBOL);
}

static off_t block_start(unsigned block)
{
    return (off_t)block * BLOCK_SYMBOLS * SYMBOL;
}

/* Read a word and a number; false with errno when the file goes on otherwise, or the number is 0 or too high. */
static bool read_entry(FILE *file, const char *word, int base, uint64_t highest, uint64_t *value)
{
    char found[32], number[32], *end = NULL;
    if (fscanf(file, "%31s %31s", found, number) == 2 && strcmp(found, word) == 0) {
        errno = 0;
        *value = strtoull(number, &end, base);
        if (errno == 0 && *end == '\0' && *value <= highest)
            return true;
    }
    errno = EINVAL;
    return false;
}

/* Read DESCRIPTION: `transfer` NUMBER, `size` BYTES, then `block` CHECKSUM for each block; numbers but SIZE in hex. */
static bool describe(struct transfer *transfer, const char *path)
{
    uint64_t number;
    FILE *file = fopen(path, "re");
    if (!file)
        return false;
    bool good = read_entry(file, "transfer", 16, UINT32_MAX, &number);
    transfer->number = good ? (uint32_t)number : 0;
    good = good && read_entry(file, "size", 10, (uint64_t)BLOCKS * BLOCK_SYMBOLS * SYMBOL, &transfer->size) &&
           transfer->size > 0;
    transfer->count = good ? (unsigned)((transfer->size - 1) / (BLOCK_SYMBOLS * SYMBOL) + 1) : 0;
    for (unsigned block = 0; good && block < transfer->count; block++) {
        good = read_entry(file, "block", 16, UINT32_MAX, &number);
        if (good)
            transfer->blocks[block] =
                (struct block){.checksum = (uint32_t)number, .goal = block_symbols(transfer, block), .repairs = NONE};
    }
    fclose(file);
    if (!good)
        errno = EINVAL;
    return good;
}

static bool read_all(int fd, void *bytes, size_t length, off_t from)
{
    ssize_t got = pread(fd, bytes, length, from);
    if (got >= 0 && (size_t)got != length)
        errno = EIO;
    return got >= 0 && (size_t)got == length;
}

static bool write_all(int fd, const void *bytes, size_t length, off_t to)
{
    ssize_t done = pwrite(fd, bytes, length, to);
    if (done >= 0 && (size_t)done != length)
        errno = ENOSPC;
    return done >= 0 && (size_t)done == length;
}

/* Whether the buffer holds the block. */
static bool is_right(const struct transfer *transfer, unsigned block)
{
    return checksum(transfer->buffer, block_bytes(transfer, block)) == transfer->blocks[block].checksum;
}

/* Open FILE.part, or FILE where it is whole already, and see which blocks it has. */
static bool open_files(struct transfer *transfer)
{
    bool again = rename(transfer->name, transfer->part_name) == 0;
    if (!again && errno != ENOENT)
        return false;
    transfer->part = open(transfer->part_name, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
    transfer->repairs = open(transfer->repairs_name, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    if (transfer->part < 0 || transfer->repairs < 0 || ftruncate(transfer->part, (off_t)transfer->size) < 0 ||
        (errno = posix_fallocate(transfer->part, 0, (off_t)transfer->size)) != 0)
        return false;
    for (unsigned block = 0; block < transfer->count; block++) {
        if (!read_all(transfer->part, transfer->buffer, block_bytes(transfer, block), block_start(block)))
            return false;
        transfer->blocks[block].whole = is_right(transfer, block);
        transfer->whole += transfer->blocks[block].whole;
    }
    return true;
}

/* Give FILE its name, if all of it is there. */
static bool finish(const struct transfer *transfer)
{
    if (transfer->whole < transfer->count)
        return true;
    if (fdatasync(transfer->part) < 0 || rename(transfer->part_name, transfer->name) < 0)
        return false;
    unlink(transfer->repairs_name);
    return puts("whole") >= 0 && fflush(stdout) == 0;
}

/* --- symbols --- */

static void forget_repairs(struct transfer *transfer, struct block *block)
{
    while (block->repairs >= 0) {
        int place = block->repairs;
        block->repairs = transfer->stored[place].next;
        transfer->stored[place].next = transfer->unused;
        transfer->unused = place;
    }
}

static bool store_repair(struct transfer *transfer, struct block *block, uint16_t number, const uint8_t *bytes)
{
    for (int place = block->repairs; place >= 0; place = transfer->stored[place].next)
        if (transfer->stored[place].number == number)
            return true;
    if (transfer->unused < 0) {
        int more = transfer->stored_count + BLOCK_SYMBOLS / 8;
        struct stored *grown = realloc(transfer->stored, (size_t)more * sizeof *grown);
        if (!grown)
            return false;
        transfer->stored = grown;
        for (int place = transfer->stored_count; place < more; place++) {
            grown[place].next = transfer->unused;
            transfer->unused = place;
        }
        transfer->stored_count = more;
    }
    int place = transfer->unused;
    if (place < 0 || !write_all(transfer->repairs, bytes, SYMBOL, (off_t)place * SYMBOL))
        return false;
    transfer->unused = transfer->stored[place].next;
    transfer->stored[place] = (struct stored){.number = number, .next = block->repairs};
    block->repairs = place;
    block->have++;
    return true;
}

struct places {
    const struct transfer *transfer;
    int *places;
};

static bool read_repair(void *context, unsigned place, uint8_t bytes[static SYMBOL])
{
    const struct places *places = context;
    return read_all(places->transfer->repairs, bytes, SYMBOL, (off_t)places->places[place] * SYMBOL);
}

/* Repair a block into the buffer: 0, or how many more symbols it takes, or -1 with errno. */
static int repaired(struct transfer *transfer, unsigned number)
{
    struct block *block = &transfer->blocks[number];
    uint16_t numbers[BLOCK_SYMBOLS];
    int places[BLOCK_SYMBOLS];
    struct repair job = {
        .symbols = block_symbols(transfer, number),
        .block = transfer->buffer,
        .present = transfer->present[number],
        .repairs = numbers,
        .read = read_repair,
        .context = &(struct places){transfer, places},
    };
    for (int place = block->repairs; place != NONE && job.count < BLOCK_SYMBOLS; place = transfer->stored[place].next) {
        numbers[job.count] = transfer->stored[place].number;
        places[job.count++] = place;
    }
    memset(transfer->buffer, 0, BLOCK_SYMBOLS * SYMBOL);
    if (!read_all(transfer->part, transfer->buffer, block_bytes(transfer, number), block_start(number)))
        return -1;
    return repair(&job);
}

/* Make the block whole if it may be. */
static bool try_block(struct transfer *transfer, unsigned number)
{
    struct block *block = &transfer->blocks[number];
    int more = block->have < block->goal ? 1 : repaired(transfer, number);
    if (more < 0)
        return false;
    if (more > 0) {
        if (block->have >= block->goal)
            block->goal = block->have + (unsigned)more;
        return true;
    }
    if (!is_right(transfer, number)) { /* something changed a symbol on its way */
        fprintf(stderr, "flotilla-receive: block %u: wrong checksum: it is received again\n", number);
        memset(transfer->present[number], 0, sizeof transfer->present[number]);
        block->have = 0;
        block->goal = block_symbols(transfer, number);
        forget_repairs(transfer, block);
        return true;
    }
    block->whole = true;
    transfer->whole++;
    forget_repairs(transfer, block);
    return write_all(transfer->part, transfer->buffer, block_bytes(transfer, number), block_start(number)) &&
           finish(transfer);
}

static bool take_symbol(struct transfer *transfer, unsigned number, uint16_t symbol, const uint8_t *bytes)
{
    struct block *block = &transfer->blocks[number];
    transfer->received++;
    if (block->whole)
        return true;
    if (symbol >= REPAIRS_FROM) {
        if (!store_repair(transfer, block, symbol, bytes))
            return false;
    } else if (symbol < block_symbols(transfer, number)) {
        uint64_t *word = &transfer->present[number][symbol / 64], mask = UINT64_C(1) << symbol % 64;
        size_t from = (size_t)symbol * SYMBOL, left = block_bytes(transfer, number) - from;
        if (*word & mask)
            return true;
        if (!write_all(transfer->part, bytes, left < SYMBOL ? left : SYMBOL, block_start(number) + (off_t)from))
            return false;
        *word |= mask;
        block->have++;
    } else {
        return true;
    }
    return try_block(transfer, number);
}

/* --- datagrams --- */

static void put16(uint8_t *to, unsigned value)
{
    to[0] = (uint8_t)(value >> 8);
    to[1] = (uint8_t)value;
}

static void put32(uint8_t *to, uint32_t value)
{
    put16(to, value >> 16);
    put16(to + 2, value & 0xffff);
}

static unsigned get16(const uint8_t *from)
{
    return (unsigned)from[0] << 8 | from[1];
}

/* The tag of a datagram; an answer's tag also covers the address of its sender. */
static void make_tag(const struct hmac_sha256_ctx *key, const struct transfer *transfer, const uint8_t *datagram,
                     size_t length, const struct in_addr *who, uint8_t tag[static TAG])
{
    uint8_t number[4];
    struct hmac_sha256_ctx hash = *key;
    put32(number, transfer->number);
    hmac_sha256_update(&hash, sizeof number, number);
    hmac_sha256_update(&hash, length - TAG, datagram + TAG);
    if (who)
        hmac_sha256_update(&hash, sizeof *who, (const uint8_t *)who);
    hmac_sha256_digest(&hash, TAG, tag);
}

/* Read KEY; false with errno. */
static bool read_key(const char *path, struct hmac_sha256_ctx *key)
{
    char digits[2 * KEY_BYTES + 1] = "";
    uint8_t bytes[BASE16_DECODE_LENGTH(2 * KEY_BYTES + 1)];
    size_t length = sizeof bytes;
    struct base16_decode_ctx decoder;
    FILE *file = fopen(path, "re");
    if (!file)
        return false;
    base16_decode_init(&decoder);
    bool good = fscanf(file, "%64s", digits) == 1 &&
                base16_decode_update(&decoder, &length, bytes, strlen(digits), digits) &&
                base16_decode_final(&decoder) && length == KEY_BYTES;
    fclose(file);
    if (good)
        hmac_sha256_set_key(key, KEY_BYTES, bytes);
    else
        errno = EINVAL;
    return good;
}

/* What this robot lacks: the question's number, datagrams received (32 bit), blocks, then each one's number and how
 * many symbols it needs. */
static size_t write_answer(const struct transfer *transfer, unsigned question, uint8_t *answer)
{
    unsigned count = 0;
    size_t at = HEADER + 6;
    for (unsigned number = 0; number < transfer->count && count < ANSWER_BLOCKS; number++) {
        const struct block *block = &transfer->blocks[number];
        if (block->whole)
            continue;
        put16(answer + at, number);
        put16(answer + at + 2, block->goal - block->have);
        at += 4;
        count++;
    }
    put16(answer + TAG, ANSWER);
    put16(answer + TAG + 2, question);
    put32(answer + HEADER, transfer->received);
    put16(answer + HEADER + 4, count);
    return at;
}

static int64_t now_ms(void)
{
    struct timespec now;
    if (clock_gettime(CLOCK_MONOTONIC, &now) < 0) {
        perror("flotilla-receive: the monotonic clock");
        exit(1);
    }
    return (int64_t)now.tv_sec * 1000 + now.tv_nsec / 1000000;
}

struct listener {
    int socket;
    struct in_addr from, at;
    struct hmac_sha256_ctx key;
    int64_t idle_ms, heard_at;
    bool asked, ended;
    unsigned question;
    int64_t answer_at;
    struct sockaddr_in station;
};

/* The addresses of a question are those who shall answer, in this order, so that answers do not collide. */
static void take_question(struct listener *listener, unsigned question, const uint8_t *addresses, size_t length)
{
    for (size_t at = 0; at + 4 <= length; at += 4)
        if (memcmp(addresses + at, &listener->at, 4) == 0) {
            listener->asked = true;
            listener->question = question;
            listener->answer_at = now_ms() + (int64_t)(at / 4) * SLOT_MS;
        }
}

static bool take_datagram(struct listener *listener, struct transfer *transfer)
{
    uint8_t datagram[HEADER + 1024], tag[TAG];
    struct sockaddr_in from = {0};
    socklen_t size = sizeof from;
    ssize_t got = recvfrom(listener->socket, datagram, sizeof datagram, 0, (struct sockaddr *)&from, &size);
    if (got < HEADER || from.sin_addr.s_addr != listener->from.s_addr)
        return true;
    make_tag(&listener->key, transfer, datagram, (size_t)got, NULL, tag);
    if (!memeql_sec(tag, datagram, TAG))
        return true;
    unsigned block = get16(datagram + TAG), symbol = get16(datagram + TAG + 2);
    listener->heard_at = now_ms();
    if (block == END) {
        listener->ended = true;
    } else if (block == QUESTION) {
        listener->station = from;
        take_question(listener, symbol, datagram + HEADER, (size_t)got - HEADER);
    } else if (block < transfer->count && got == HEADER + SYMBOL) {
        return take_symbol(transfer, block, (uint16_t)symbol, datagram + HEADER);
    }
    return true;
}

static void give_answer(struct listener *listener, const struct transfer *transfer)
{
    uint8_t answer[HEADER + 6 + 4 * ANSWER_BLOCKS];
    size_t length = write_answer(transfer, listener->question, answer);
    make_tag(&listener->key, transfer, answer, length, &listener->at, answer);
    listener->asked = false;
    /* A lost answer is asked for again. */
    (void)!sendto(listener->socket, answer, length, 0, (struct sockaddr *)&listener->station, sizeof listener->station);
}

/* Returns the exit status. */
static int listen_to(struct listener *listener, struct transfer *transfer)
{
    listener->heard_at = now_ms();
    while (!listener->ended) {
        int64_t until = listener->asked ? listener->answer_at : listener->heard_at + listener->idle_ms;
        int64_t left = until - now_ms();
        struct pollfd waiting = {.fd = listener->socket, .events = POLLIN};
        if (poll(&waiting, 1, left > 0 ? (int)left : 0) < 0 && errno != EINTR)
            return fail("poll");
        if (waiting.revents && !take_datagram(listener, transfer))
            return fail(transfer->part_name);
        if (listener->asked && now_ms() >= listener->answer_at)
            give_answer(listener, transfer);
        else if (now_ms() - listener->heard_at >= listener->idle_ms)
            break;
    }
    return transfer->whole == transfer->count ? 0 : 3;
}

/* It is opened before blocks are read: datagrams that arrive meanwhile wait in it. */
static bool open_socket(struct listener *listener, struct in_addr group, unsigned port)
{
    static const int room = RECEIVE_BYTES, on = 1;
    struct sockaddr_in local = {.sin_family = AF_INET, .sin_port = htons((uint16_t)port), .sin_addr = group};
    struct ip_mreq membership = {.imr_multiaddr = group, .imr_interface = listener->at};
    listener->socket = socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    /* While a block is repaired, the socket holds what arrives. */
    return listener->socket >= 0 && setsockopt(listener->socket, SOL_SOCKET, SO_RCVBUF, &room, sizeof room) == 0 &&
           setsockopt(listener->socket, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on) == 0 &&
           bind(listener->socket, (struct sockaddr *)&local, sizeof local) == 0 &&
           setsockopt(listener->socket, IPPROTO_IP, IP_ADD_MEMBERSHIP, &membership, sizeof membership) == 0;
}

static long number_of(const char *text, long highest)
{
    char *end;
    errno = 0;
    long value = strtol(text, &end, 10);
    return errno || end == text || *end || value < 1 || value > highest ? -1 : value;
}

static struct transfer transfer; /* pages that are never touched take no memory */

int main(int argc, char **argv)
{
    struct listener listener = {.idle_ms = 600 * 1000};
    struct in_addr group = {.s_addr = htonl(0xefff2a2a)};
    const char *key = NULL;
    long port = 4242, idle;
    for (int option, index = 0; (option = getopt_long(argc, argv, "", options, &index)) != -1;) {
        bool good = true;
        switch (option) {
        case FROM:
            good = inet_pton(AF_INET, optarg, &listener.from) == 1;
            break;
        case AT:
            good = inet_pton(AF_INET, optarg, &listener.at) == 1;
            break;
        case KEY:
            key = optarg;
            break;
        case GROUP:
            good = inet_pton(AF_INET, optarg, &group) == 1 && IN_MULTICAST(ntohl(group.s_addr));
            break;
        case PORT:
            good = (port = number_of(optarg, 65535)) > 0;
            break;
        case IDLE:
            good = (idle = number_of(optarg, 1000 * 1000)) > 0;
            listener.idle_ms = idle * 1000;
            break;
        case HELP:
            fputs(usage, stdout);
            return 0;
        case VERSION:
            puts("flotilla-receive " FLOTILLA_VERSION);
            return 0;
        default:
            fputs(usage, stderr);
            return 2;
        }
        if (!good) {
            fprintf(stderr, "flotilla-receive: --%s: %s: give %s\n", options[index].name, optarg,
                    option == PORT    ? "a port, 1 to 65535"
                    : option == IDLE  ? "seconds, 1 to 1000000"
                    : option == GROUP ? "a multicast address, such as 239.255.42.42"
                                      : "an IPv4 address");
            return 2;
        }
    }
    if (argc - optind != 2 || !listener.from.s_addr || !listener.at.s_addr || !key) {
        fputs(usage, stderr);
        return 2;
    }
    transfer.name = argv[optind + 1];
    transfer.unused = NONE;
    if (snprintf(transfer.part_name, PATH_MAX, "%s.part", transfer.name) >= PATH_MAX ||
        snprintf(transfer.repairs_name, PATH_MAX, "%s.repair", transfer.name) >= PATH_MAX) {
        errno = ENAMETOOLONG;
        return fail(transfer.name);
    }
    if (!read_key(key, &listener.key)) {
        fail(key);
        return 2;
    }
    if (!describe(&transfer, argv[optind])) {
        fail(argv[optind]);
        return 2;
    }
    if (!open_socket(&listener, group, (unsigned)port))
        return fail("socket");
    if (!open_files(&transfer) || !finish(&transfer))
        return fail(transfer.name);
    return listen_to(&listener, &transfer);
}
