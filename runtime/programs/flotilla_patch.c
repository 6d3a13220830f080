/* flotilla-patch: a release from the one that runs and a delta between the two, in VCDIFF (RFC 3284).
 *
 * The delta was made by xdelta3, without its extensions. xdelta3 itself takes no block device as a source that it could
 * seek in. The delta is not trusted: what comes out is only as good as the checksums that the reader compares. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <grp.h>
#include <inttypes.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <unistd.h>

static const char usage[] =
    "usage: flotilla-patch BASE <DELTA >RESULT\n"
    "Apply a delta to BASE, a file or a block device, which is only read. Root gives up its privileges for that.\n"
    "\n"
    "  --help, --version\n"
    "\n"
    "Status: 0 done, 1 an error of the system, 2 the command line is wrong, 3 the delta is wrong, or ends early.\n";

enum {
    WINDOW = 1 << 18, /* bytes of the result at a time, as flotilla/updates/delta.py has it made */
    NEAR = 4,         /* addresses that were used last */
    SAME = 3,         /* × 256 addresses by their remainder */
    USER = 903,       /* `update`, UPDATE_USER of flotilla/fleet/privileges.py */
};

enum { SOURCE = 1 };                /* of a window's indicator: it copies from BASE */
enum kind { NOOP, ADD, RUN, COPY }; /* of an instruction */
enum { SELF, HERE, NEARS };         /* modes of an address; then SAMES */
enum { SAMES = NEARS + NEAR, MODES = SAMES + SAME };

struct instruction {
    enum kind kind;
    unsigned size; /* 0: it follows */
    unsigned mode; /* of a copy's address */
};

/* Bytes of a section, from the next one on. */
struct section {
    const uint8_t *at, *end;
};

/* Sections are at most as long as a window: an instruction takes no more bytes than it makes. */
static uint8_t target[WINDOW], bytes[3][WINDOW];
static struct instruction table[256][2];

struct window {
    uint64_t source_start, source_size;
    size_t length, made; /* bytes of the result */
    struct section data, instructions, addresses;
    uint64_t near[NEAR], same[SAME * 256];
    unsigned next_near;
};

/* The table of RFC 3284, section 5.6. */
static void make_table(void)
{
    unsigned at = 0;
    table[at++][0] = (struct instruction){RUN, 0, 0};
    for (unsigned size = 0; size <= 17; size++)
        table[at++][0] = (struct instruction){ADD, size, 0};
    for (unsigned mode = 0; mode < MODES; mode++) {
        table[at++][0] = (struct instruction){COPY, 0, mode};
        for (unsigned size = 4; size <= 18; size++)
            table[at++][0] = (struct instruction){COPY, size, mode};
    }
    for (unsigned mode = 0; mode < MODES; mode++)
        for (unsigned size = 1; size <= 4; size++)
            for (unsigned copied = 4; copied <= (mode < SAMES ? 6 : 4); copied++) {
                table[at][0] = (struct instruction){ADD, size, 0};
                table[at++][1] = (struct instruction){COPY, copied, mode};
            }
    for (unsigned mode = 0; mode < MODES; mode++) {
        table[at][0] = (struct instruction){COPY, 4, mode};
        table[at++][1] = (struct instruction){ADD, 1, 0};
    }
}

/* --- numbers: seven bits a byte, the highest first --- */

static bool take_number(struct section *section, uint64_t *number)
{
    *number = 0;
    while (section->at < section->end && *number <= UINT64_MAX >> 7) {
        uint8_t byte = *section->at++;
        *number = *number << 7 | (byte & 0x7f);
        if (byte < 0x80)
            return true;
    }
    return false;
}

static bool read_number(FILE *in, uint64_t highest, uint64_t *number)
{
    int byte;
    *number = 0;
    while (*number <= UINT64_MAX >> 7 && (byte = getc(in)) != EOF) {
        *number = *number << 7 | (unsigned)(byte & 0x7f);
        if (byte < 0x80)
            return *number <= highest;
    }
    return false;
}

/* --- instructions --- */

static bool take_address(struct window *window, unsigned mode, uint64_t *address)
{
    uint64_t here = window->source_size + window->made, number;
    if (mode >= SAMES) {
        if (window->addresses.at == window->addresses.end)
            return false;
        *address = window->same[(mode - SAMES) * 256 + *window->addresses.at++];
    } else {
        if (!take_number(&window->addresses, &number))
            return false;
        *address = mode == SELF ? number : mode == HERE ? here - number : window->near[mode - NEARS] + number;
    }
    window->near[window->next_near] = *address;
    window->next_near = (window->next_near + 1) % NEAR;
    window->same[*address % (SAME * 256)] = *address;
    return *address < here;
}

static bool copy(struct window *window, int base, uint64_t address, size_t size)
{
    if (address < window->source_size) {
        uint64_t left = window->source_size - address;
        size_t part = left < size ? (size_t)left : size;
        ssize_t got = pread(base, target + window->made, part, (off_t)(window->source_start + address));
        if (got < 0 || (size_t)got != part)
            return false;
        window->made += part;
        address += part;
        size -= part;
    }
    /* Byte by byte: what is copied may begin with the copy itself. */
    for (uint64_t from = address - window->source_size; size > 0; size--)
        target[window->made++] = target[from++];
    return true;
}

static bool execute(struct window *window, int base, struct instruction instruction)
{
    uint64_t size = instruction.size, address;
    if (instruction.kind == NOOP)
        return true;
    if ((size == 0 && !take_number(&window->instructions, &size)) || size > window->length - window->made)
        return false;
    if (instruction.kind == COPY)
        return take_address(window, instruction.mode, &address) && copy(window, base, address, (size_t)size);
    size_t taken = instruction.kind == RUN ? 1 : (size_t)size;
    if ((size_t)(window->data.end - window->data.at) < taken)
        return false;
    if (instruction.kind == RUN)
        memset(target + window->made, *window->data.at, (size_t)size);
    else
        memcpy(target + window->made, window->data.at, (size_t)size);
    window->data.at += taken;
    window->made += (size_t)size;
    return true;
}

/* --- windows --- */

static bool read_section(FILE *in, unsigned number, uint64_t length, struct section *section)
{
    *section = (struct section){bytes[number], bytes[number] + length};
    return fread(bytes[number], 1, (size_t)length, in) == length;
}

/* Read a window after its indicator. */
static bool read_window(FILE *in, int indicator, struct window *window)
{
    uint64_t rest, length, data, instructions, addresses;
    *window = (struct window){0};
    if ((indicator & ~SOURCE) != 0)
        return false;
    if (indicator == SOURCE && (!read_number(in, INT64_MAX / 2, &window->source_size) ||
                                !read_number(in, INT64_MAX / 2, &window->source_start)))
        return false;
    /* Neither is any section compressed. */
    if (!read_number(in, 4 * (uint64_t)WINDOW, &rest) || !read_number(in, WINDOW, &length) || getc(in) != 0 ||
        !read_number(in, WINDOW, &data) || !read_number(in, WINDOW, &instructions) ||
        !read_number(in, WINDOW, &addresses))
        return false;
    window->length = (size_t)length;
    return read_section(in, 0, data, &window->data) && read_section(in, 1, instructions, &window->instructions) &&
           read_section(in, 2, addresses, &window->addresses);
}

static bool make_window(struct window *window, int base)
{
    while (window->instructions.at < window->instructions.end) {
        const struct instruction *pair = table[*window->instructions.at++];
        if (!execute(window, base, pair[0]) || !execute(window, base, pair[1]))
            return false;
    }
    return window->made == window->length;
}

static bool write_result(size_t length)
{
    for (size_t done = 0; done < length;) {
        ssize_t part = write(STDOUT_FILENO, target + done, length - done);
        if (part < 0 && errno != EINTR)
            return false;
        done += part > 0 ? (size_t)part : 0;
    }
    return true;
}

static int patch(FILE *in, int base)
{
    static const uint8_t magic[5] = {0xd6, 0xc3, 0xc4, 0, 0}; /* VCDIFF, its version, no extensions */
    static struct window window;
    uint8_t found[sizeof magic];
    make_table();
    bool good = fread(found, 1, sizeof found, in) == sizeof found && memcmp(found, magic, sizeof magic) == 0;
    for (int indicator; good && (indicator = getc(in)) != EOF;) {
        good = read_window(in, indicator, &window) && make_window(&window, base);
        /* The page cache belongs to the control tasks. */
        (void)posix_fadvise(base, 0, 0, POSIX_FADV_DONTNEED);
        if (good && !write_result(window.length)) {
            fprintf(stderr, "flotilla-patch: output: %s\n", strerror(errno));
            return 1;
        }
    }
    if (ferror(in)) {
        fprintf(stderr, "flotilla-patch: input: %s\n", strerror(errno));
        return 1;
    }
    if (!good)
        fputs("flotilla-patch: input: no delta of this base, or it ends early\n", stderr);
    return good ? 0 : 3;
}

/* Once BASE is open, nothing needs root: become a user who owns no file. */
static bool give_up_privileges(void)
{
    return prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0 &&
           (geteuid() != 0 ||
            (setgroups(0, NULL) == 0 && setresgid(USER, USER, USER) == 0 && setresuid(USER, USER, USER) == 0));
}

int main(int argc, char **argv)
{
    if (argc == 2 && strcmp(argv[1], "--help") == 0) {
        fputs(usage, stdout);
        return 0;
    }
    if (argc == 2 && strcmp(argv[1], "--version") == 0) {
        puts("flotilla-patch " FLOTILLA_VERSION);
        return 0;
    }
    if (argc != 2 || argv[1][0] == '-') {
        fputs(usage, stderr);
        return 2;
    }
    int base = open(argv[1], O_RDONLY | O_CLOEXEC);
    if (base < 0) {
        fprintf(stderr, "flotilla-patch: %s: %s\n", argv[1], strerror(errno));
        return 1;
    }
    if (!give_up_privileges()) {
        fprintf(stderr, "flotilla-patch: user %d: %s\n", USER, strerror(errno));
        return 1;
    }
    return patch(stdin, base);
}
