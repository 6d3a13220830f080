/* Messages that prove who sent them, to whom, to which port, and that they are new, over any datagrams.
 *
 * Each pair of computers shares a key for each direction. A message ends with a trailer, all numbers little-endian:
 *
 *   payload | session uint64 | counter uint64 | answer uint64 | tag, 16 bytes
 *
 * `session` is drawn when the sender begins, and `counter` counts its messages from 1. `tag` is that of
 * ChaCha20-Poly1305 (RFC 8439) for all before it as associated data, and no text. Its nonce is the session and the
 * counter's lower half. Its key is HMAC-SHA-256 (RFC 2104) of the shared one over 'M' and the receiver's port (uint16).
 * A receiver does not know whether a session it has not heard of is new or recorded. So it takes no message of it, and
 * answers with a challenge:
 *
 *   session uint64 | counter uint64 | challenge uint64 | tag, 16 bytes
 *
 * `counter` is that of the message that it answers. `tag` is HMAC-SHA-256-128 (RFC 4868) by the shared key over 'C',
 * the receiver's port and all before the tag: the same counter may be asked for twice. The sender repeats the newest
 * challenge as `answer` in all of its messages from then on, and the receiver takes them, each counter once and in
 * ascending order. Nothing has to survive a restart, on neither side. A payload is not encrypted.
 */
#ifndef FLOTILLA_CORE_AUTHENTICATION_H
#define FLOTILLA_CORE_AUTHENTICATION_H

#include <flotilla/block.h>
#include <netinet/in.h>
#include <nettle/chacha-poly1305.h>
#include <nettle/hmac.h>

enum {
    AUTHENTICATION_KEY = 32,       /* bytes */
    AUTHENTICATION_TRAILER = 40,   /* likewise */
    AUTHENTICATION_CHALLENGE = 40, /* likewise */
};

/* --- keys --- */

/* The file with a parameter's value: absolute, or relative to the service's credentials (systemd.exec(5),
 * LoadCredential=), and without those to /etc/flotilla. A line for each computer: address, key of messages to it, key
 * of messages from it, each 64 hexadecimal digits. */
enum authentication_direction { AUTHENTICATION_TO, AUTHENTICATION_FROM };

/* Read the key of messages to or from `address`. FL_OK, or FL_FAILED after fl_fail(). Not for the step. */
int authentication_read_key(struct fl_block *block, const char *file, struct in_addr address,
                            enum authentication_direction direction, uint8_t key[AUTHENTICATION_KEY]);

enum authentication_verdict {
    AUTHENTICATION_GOOD,
    AUTHENTICATION_FORGED,     /* the tag is wrong */
    AUTHENTICATION_REPLAYED,   /* it came before, or a newer one did */
    AUTHENTICATION_UNANSWERED, /* of a message: send it the challenge */
};

/* --- sending --- */

struct authentication_sender {
    struct chacha_poly1305_ctx messages;
    struct hmac_sha256_ctx challenges;
    uint16_t port;
    uint64_t session;
    uint64_t counter;
    uint64_t answer;
    uint64_t challenged; /* counter of the message that `answer` came for */
};

/* A new session of messages to a port. Not for the step. */
void authentication_sender_begin(struct authentication_sender *sender, const uint8_t key[AUTHENTICATION_KEY],
                                 uint16_t port);

/* Write the trailer behind the payload of `length` bytes. A session has 2³² − 1 messages, which are 497 days of 100 a
 * second; then a new one begins. */
void authentication_sign(struct authentication_sender *sender, uint8_t *message, size_t length);

/* Take what came back. AUTHENTICATION_FORGED also where it has another length than a challenge; a challenge of the
 * receiver to another session is AUTHENTICATION_REPLAYED. */
enum authentication_verdict authentication_challenged(struct authentication_sender *sender, const uint8_t *bytes,
                                                      size_t length);

/* --- receiving --- */

struct authentication_receiver {
    struct chacha_poly1305_ctx messages;
    struct hmac_sha256_ctx challenges;
    struct hmac_sha256_ctx secret; /* of this receiver alone: its challenges cannot be guessed */
    uint16_t port;
    uint64_t taken; /* sessions taken so far: a challenge holds until the next is taken */
    uint64_t session;
    uint64_t counter;
    uint64_t answer;
};

/* From nobody yet. Not for the step. */
void authentication_receiver_begin(struct authentication_receiver *receiver, const uint8_t key[AUTHENTICATION_KEY],
                                   uint16_t port);

/* Judge a payload of `length` bytes by its trailer. `challenge` is written when the verdict asks for it. */
enum authentication_verdict authentication_judge(struct authentication_receiver *receiver, const uint8_t *payload,
                                                 size_t length, const uint8_t trailer[AUTHENTICATION_TRAILER],
                                                 uint8_t challenge[AUTHENTICATION_CHALLENGE]);

#endif
