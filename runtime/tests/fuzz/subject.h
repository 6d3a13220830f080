/* The parsers under fuzzing, and what must hold of each however its bytes came about.
 *
 * Where a format has a checksum, a measurement is checked against the bytes that it came from, by other code than the
 * parser's: so a corrupted frame that is taken for good shows, not only a crash.
 */
#ifndef FLOTILLA_FUZZ_SUBJECT_H
#define FLOTILLA_FUZZ_SUBJECT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct subject {
    const char *name;
    const char *sound; /* a stream of good frames: seeds and what is mutated */
    size_t sound_size;
    void (*begin)(void);
    bool (*feed)(uint8_t byte);

    /* After feed() said true: NULL, or what is wrong, given all bytes so far, the last completed the measurement. */
    const char *(*wrong)(const uint8_t *bytes, size_t count);
};

extern const struct subject subjects[];
extern const size_t subject_count;

/* Feed a parser a whole stream. The number of measurements; on the first that is wrong, say so and abort. */
size_t subject_run(const struct subject *subject, const uint8_t *bytes, size_t count);

#endif
