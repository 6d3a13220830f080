/* libFuzzer's entry for the input of flotilla-receive: a description and a key, or datagrams, by the lowest bit of the
 * first byte. Tags are right: a robot that was taken over has the key. Seen to find that a block's number was not
 * compared with the transfer's.
 *
 * Datagrams come as records of 6 bytes: length / 4 (0xff: that of a symbol), block, symbol (16 bit each), content. */
int flotilla_receive(int argc, char **argv);
#define main flotilla_receive
#include "programs/flotilla_receive.c"
#undef main

#include <sys/mman.h>

int LLVMFuzzerTestOneInput(const uint8_t *given, size_t count);

enum { RECORD = 6, BYTES = 5 * SYMBOL + 100 };

static int memory(const char *name)
{
    int fd = memfd_create(name, 0);
    if (fd < 0)
        abort();
    return fd;
}

static void read_description(const uint8_t *given, size_t count)
{
    static int file = -1;
    static char name[64];
    struct hmac_sha256_ctx key;
    if (file < 0) {
        file = memory("description");
        snprintf(name, sizeof name, "/proc/self/fd/%d", file);
    }
    if (ftruncate(file, 0) < 0 || !write_all(file, given, count, 0))
        abort();
    if (describe(&transfer, name) &&
        (transfer.count == 0 || transfer.count > BLOCKS || block_bytes(&transfer, transfer.count - 1) == 0))
        abort();
    (void)read_key(name, &key);
}

static void receive(const uint8_t *given, size_t count)
{
    static const uint8_t secret[KEY_BYTES] = {1};
    static struct listener listener;
    static int ends[2] = {-1, -1};
    if (ends[0] < 0) {
        if (socketpair(AF_UNIX, SOCK_DGRAM, 0, ends) < 0)
            abort();
        transfer.part = memory("part");
        transfer.repairs = memory("repairs");
        hmac_sha256_set_key(&listener.key, KEY_BYTES, secret);
        listener.at.s_addr = htonl(0x0a000001);
    }
    listener.socket = ends[0];
    listener.ended = listener.asked = false;
    transfer.number = 1;
    transfer.size = BYTES;
    transfer.count = 1;
    transfer.whole = 0;
    transfer.received = 0;
    transfer.unused = NONE;
    free(transfer.stored);
    transfer.stored = NULL;
    transfer.stored_count = 0;
    transfer.name = transfer.part_name;
    snprintf(transfer.part_name, PATH_MAX, "/nowhere/part");
    memset(transfer.present[0], 0, sizeof transfer.present[0]);
    transfer.blocks[0] = (struct block){.checksum = 1, .goal = block_symbols(&transfer, 0), .repairs = NONE};
    if (ftruncate(transfer.part, 0) < 0 || ftruncate(transfer.part, BYTES) < 0 || ftruncate(transfer.repairs, 0) < 0)
        abort();
    for (; count >= RECORD && !listener.ended; given += RECORD, count -= RECORD) {
        uint8_t datagram[HEADER + 1024];
        size_t length = given[0] == 0xff ? HEADER + SYMBOL : HEADER + given[0] * (size_t)4;
        memset(datagram, given[5], sizeof datagram);
        memcpy(datagram + TAG, given + 1, 4);
        make_tag(&listener.key, &transfer, datagram, length, NULL, datagram);
        if (send(ends[1], datagram, length, 0) != (ssize_t)length || !take_datagram(&listener, &transfer))
            return;
        if (listener.asked) {
            uint8_t answer[HEADER + 6 + 4 * ANSWER_BLOCKS];
            if (write_answer(&transfer, listener.question, answer) > sizeof answer)
                abort();
            listener.asked = false;
        }
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *given, size_t count)
{
    static bool begun;
    if (!begun)
        stderr = fopen("/dev/null", "we"); /* of the program alone: sanitizers write to the descriptor */
    begun = true;
    if (count)
        (given[0] & 1 ? receive : read_description)(given + 1, count - 1);
    return 0;
}
