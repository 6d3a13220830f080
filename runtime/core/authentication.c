#define _GNU_SOURCE
#include "authentication.h"

#include "wall_clock.h"

#include <arpa/inet.h>
#include <endian.h>
#include <errno.h>
#include <nettle/base16.h>
#include <nettle/memops.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>

enum { NUMBER = 8, TAG = 16 };
/* Where the numbers of a trailer and of a challenge lie, and what follows them. */
enum { SESSION = 0, COUNTER = 8, ANSWER = 16, SIGNED = 24 };
enum kind { MESSAGE = 'M', CHALLENGE = 'C' };

/* --- keys --- */

enum { ADDRESS = 15, DIGITS = 2 * AUTHENTICATION_KEY, LINE = 256, PATH = 512 };

static bool read_digits(const char *text, uint8_t key[AUTHENTICATION_KEY])
{
    struct base16_decode_ctx digits;
    size_t length;
    base16_decode_init(&digits);
    return strlen(text) == DIGITS && base16_decode_update(&digits, &length, key, DIGITS, text) &&
           length == AUTHENTICATION_KEY;
}

/* Whether the line is that of `address`; a line that is none of the format is not. */
static bool read_line(const char *line, struct in_addr address, enum authentication_direction direction,
                      uint8_t key[AUTHENTICATION_KEY])
{
    char name[ADDRESS + 1], digits[2][DIGITS + 1];
    struct in_addr found;
    return sscanf(line, "%15s %64s %64s", name, digits[AUTHENTICATION_TO], digits[AUTHENTICATION_FROM]) == 3 &&
           inet_pton(AF_INET, name, &found) == 1 && found.s_addr == address.s_addr &&
           read_digits(digits[direction], key);
}

int authentication_read_key(struct fl_block *block, const char *file, struct in_addr address,
                            enum authentication_direction direction, uint8_t key[AUTHENTICATION_KEY])
{
    char path[PATH], line[LINE], text[INET_ADDRSTRLEN];
    const char *directory = getenv("CREDENTIALS_DIRECTORY");
    bool found = false;
    snprintf(path, sizeof path, "%s%s%s",
             *file == '/' ? ""
             : directory  ? directory
                          : "/etc/flotilla",
             *file == '/' ? "" : "/", file);
    FILE *stream = fopen(path, "re");
    if (!stream)
        return fl_fail(block, "parameter keys: %s: %s", path, strerror(errno));
    while (!found && fgets(line, sizeof line, stream))
        found = read_line(line, address, direction, key);
    fclose(stream);
    explicit_bzero(line, sizeof line);
    if (!found)
        return fl_fail(block, "parameter keys: %s has no key for %s; each line is an address and two keys of %d digits",
                       path, inet_ntop(AF_INET, &address, text, sizeof text), DIGITS);
    return FL_OK;
}

/* --- both sides --- */

static void put(uint8_t *bytes, uint64_t number)
{
    number = htole64(number);
    memcpy(bytes, &number, NUMBER);
}

static uint64_t get(const uint8_t *bytes)
{
    uint64_t number;
    memcpy(&number, bytes, NUMBER);
    return le64toh(number);
}

static void begin_hash(struct hmac_sha256_ctx *hash, enum kind kind, uint16_t port)
{
    const uint8_t head[] = {(uint8_t)kind, (uint8_t)port, (uint8_t)(port >> 8)};
    hmac_sha256_update(hash, sizeof head, head);
}

static void set_keys(const uint8_t key[AUTHENTICATION_KEY], uint16_t port, struct chacha_poly1305_ctx *messages,
                     struct hmac_sha256_ctx *challenges)
{
    uint8_t derived[CHACHA_POLY1305_KEY_SIZE];
    hmac_sha256_set_key(challenges, AUTHENTICATION_KEY, key);
    struct hmac_sha256_ctx hash = *challenges;
    begin_hash(&hash, MESSAGE, port);
    hmac_sha256_digest(&hash, sizeof derived, derived);
    chacha_poly1305_set_key(messages, derived);
    explicit_bzero(derived, sizeof derived);
}

static void tag_message(const struct chacha_poly1305_ctx *messages, const uint8_t *payload, size_t length,
                        const uint8_t *numbers, uint8_t tag[TAG])
{
    struct chacha_poly1305_ctx cipher = *messages;
    chacha_poly1305_set_nonce(&cipher, numbers); /* the session, and the lower half of the counter */
    chacha_poly1305_update(&cipher, length, payload);
    chacha_poly1305_update(&cipher, SIGNED, numbers);
    chacha_poly1305_digest(&cipher, TAG, tag);
}

static void tag_challenge(const struct hmac_sha256_ctx *challenges, uint16_t port, const uint8_t *numbers,
                          uint8_t tag[TAG])
{
    struct hmac_sha256_ctx hash = *challenges;
    begin_hash(&hash, CHALLENGE, port);
    hmac_sha256_update(&hash, SIGNED, numbers);
    hmac_sha256_digest(&hash, TAG, tag);
}

/* What is never drawn twice, and what nobody can guess without the key, even where a computer has just started and the
 * kernel has gathered next to nothing by chance: the key and the clocks do it then. */
static void draw(const uint8_t key[AUTHENTICATION_KEY], uint8_t drawn[AUTHENTICATION_KEY])
{
    struct {
        uint8_t chance[AUTHENTICATION_KEY];
        int64_t clocks_ns[2];
    } seed;
    struct hmac_sha256_ctx hash;
    memset(&seed, 0, sizeof seed);                                     /* its gaps, too */
    if (getrandom(seed.chance, sizeof seed.chance, GRND_NONBLOCK) < 0) /* waiting would hold up the task */
        getrandom(seed.chance, sizeof seed.chance, GRND_INSECURE);
    seed.clocks_ns[0] = fl_clock_ns(CLOCK_REALTIME);
    seed.clocks_ns[1] = fl_clock_ns(CLOCK_MONOTONIC);
    hmac_sha256_set_key(&hash, AUTHENTICATION_KEY, key);
    hmac_sha256_update(&hash, sizeof seed, (const uint8_t *)&seed);
    hmac_sha256_digest(&hash, AUTHENTICATION_KEY, drawn);
}

/* --- sending --- */

void authentication_sender_begin(struct authentication_sender *sender, const uint8_t key[AUTHENTICATION_KEY],
                                 uint16_t port)
{
    uint8_t drawn[AUTHENTICATION_KEY];
    draw(key, drawn);
    *sender = (struct authentication_sender){.port = port, .session = get(drawn)};
    set_keys(key, port, &sender->messages, &sender->challenges);
}

void authentication_sign(struct authentication_sender *sender, uint8_t *message, size_t length)
{
    uint8_t *trailer = message + length;
    if (sender->counter == UINT32_MAX) { /* a nonce must not come twice */
        sender->session++;
        sender->counter = sender->answer = sender->challenged = 0;
    }
    put(trailer + SESSION, sender->session);
    put(trailer + COUNTER, ++sender->counter);
    put(trailer + ANSWER, sender->answer);
    tag_message(&sender->messages, message, length, trailer, trailer + SIGNED);
}

enum authentication_verdict authentication_challenged(struct authentication_sender *sender, const uint8_t *bytes,
                                                      size_t length)
{
    uint8_t tag[TAG];
    if (length != AUTHENTICATION_CHALLENGE)
        return AUTHENTICATION_FORGED;
    tag_challenge(&sender->challenges, sender->port, bytes, tag);
    if (!memeql_sec(tag, bytes + SIGNED, TAG))
        return AUTHENTICATION_FORGED;
    uint64_t counter = get(bytes + COUNTER);
    if (get(bytes + SESSION) != sender->session || counter <= sender->challenged || counter > sender->counter)
        return AUTHENTICATION_REPLAYED;
    sender->challenged = counter;
    sender->answer = get(bytes + ANSWER);
    return AUTHENTICATION_GOOD;
}

/* --- receiving --- */

void authentication_receiver_begin(struct authentication_receiver *receiver, const uint8_t key[AUTHENTICATION_KEY],
                                   uint16_t port)
{
    uint8_t drawn[AUTHENTICATION_KEY];
    draw(key, drawn);
    *receiver = (struct authentication_receiver){.port = port};
    set_keys(key, port, &receiver->messages, &receiver->challenges);
    hmac_sha256_set_key(&receiver->secret, AUTHENTICATION_KEY, drawn);
}

/* The answer that is wanted of a session that is not taken. */
static uint64_t wanted(const struct authentication_receiver *receiver, uint64_t session)
{
    struct hmac_sha256_ctx hash = receiver->secret;
    uint8_t numbers[2 * NUMBER], digest[NUMBER];
    put(numbers, session);
    put(numbers + NUMBER, receiver->taken);
    hmac_sha256_update(&hash, sizeof numbers, numbers);
    hmac_sha256_digest(&hash, sizeof digest, digest);
    return get(digest);
}

enum authentication_verdict authentication_judge(struct authentication_receiver *receiver, const uint8_t *payload,
                                                 size_t length, const uint8_t trailer[AUTHENTICATION_TRAILER],
                                                 uint8_t challenge[AUTHENTICATION_CHALLENGE])
{
    uint64_t session = get(trailer + SESSION), counter = get(trailer + COUNTER), answer = get(trailer + ANSWER);
    bool known = receiver->taken && session == receiver->session;
    uint8_t tag[TAG];
    tag_message(&receiver->messages, payload, length, trailer, tag);
    if (!memeql_sec(tag, trailer + SIGNED, TAG))
        return AUTHENTICATION_FORGED;
    if (known && counter <= receiver->counter)
        return AUTHENTICATION_REPLAYED;
    if (!known || answer != receiver->answer) {
        uint64_t right = wanted(receiver, session);
        if (answer != right) {
            put(challenge + SESSION, session);
            put(challenge + COUNTER, counter);
            put(challenge + ANSWER, right);
            tag_challenge(&receiver->challenges, receiver->port, challenge, challenge + SIGNED);
            return AUTHENTICATION_UNANSWERED;
        }
        receiver->session = session;
        receiver->answer = answer;
        receiver->taken++;
    }
    receiver->counter = counter;
    return AUTHENTICATION_GOOD;
}
