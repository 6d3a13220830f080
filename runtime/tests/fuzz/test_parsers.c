/* A million streams of bytes for each parser, the same at every run: noise, and good frames with something done to
 * them. What must hold of the measurements is in subject.c. */
#include "subject.h"
#include "testbed.h"

#include <time.h>

#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
enum { STREAMS = 20 * 1000 };
#else
enum { STREAMS = 1000 * 1000 };
#endif
enum { LONGEST = 1024 };

/* xorshift64 (Marsaglia 2003): the C library's generators differ between libraries. */
static uint64_t state_of_chance;

static uint32_t below(uint32_t limit)
{
    state_of_chance ^= state_of_chance << 13;
    state_of_chance ^= state_of_chance >> 7;
    state_of_chance ^= state_of_chance << 17;
    return (uint32_t)((state_of_chance >> 32) * limit >> 32);
}

static size_t noise(uint8_t *bytes)
{
    size_t count = below(128);
    for (size_t i = 0; i < count; i++)
        bytes[i] = (uint8_t)below(256);
    return count;
}

/* One to three copies of the good stream from anywhere in it, and up to four accidents. */
static size_t accidents(const struct subject *subject, uint8_t *bytes)
{
    size_t count = subject->sound_size * (1 + below(3)), begin = below((uint32_t)subject->sound_size);
    if (count > LONGEST)
        count = LONGEST;
    for (size_t i = 0; i < count; i++)
        bytes[i] = (uint8_t)subject->sound[(begin + i) % subject->sound_size];
    for (uint32_t left = below(5); left && count > 1; left--) {
        size_t at = below((uint32_t)count), length = 1 + below(8);
        length = length > count - at ? count - at : length;
        switch (below(5)) {
        case 0: /* a bit flips */
            bytes[at] ^= (uint8_t)(1u << below(8));
            break;
        case 1: /* bytes are lost */
            memmove(bytes + at, bytes + at + length, count - at - length);
            count -= length;
            break;
        case 2: /* bytes come twice */
            if (count + length <= LONGEST) {
                memmove(bytes + at + length, bytes + at, count - at);
                count += length;
            }
            break;
        case 3: /* noise */
            for (size_t i = at; i < at + length; i++)
                bytes[i] = (uint8_t)below(256);
            break;
        case 4: /* bytes of another place: they belong to the alphabet */
            memmove(bytes + at, bytes + below((uint32_t)(count - length + 1)), length);
            break;
        }
    }
    return count;
}

static void is_found_when_it_is_there(void **state)
{
    (void)state;
    for (size_t i = 0; i < subject_count; i++) {
        uint8_t bytes[LONGEST];
        memcpy(bytes, subjects[i].sound, subjects[i].sound_size);
        assert_true(subject_run(&subjects[i], bytes, subjects[i].sound_size) > 0);
    }
}

static void takes_anything(void **state)
{
    (void)state;
    for (size_t i = 0; i < subject_count; i++) {
        uint8_t bytes[LONGEST];
        size_t found = 0;
        clock_t begun = clock();
        state_of_chance = 0x9E3779B97F4A7C15;
        for (unsigned stream = 0; stream < STREAMS; stream++) {
            size_t count = stream % 4 ? accidents(&subjects[i], bytes) : noise(bytes);
            found += subject_run(&subjects[i], bytes, count);
        }
        print_message("%s: %zu measurements, %.1f s\n", subjects[i].name, found,
                      (double)(clock() - begun) / CLOCKS_PER_SEC);
        assert_true(found > STREAMS / 10); /* else the accidents leave nothing to be judged */
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(is_found_when_it_is_there), cmocka_unit_test(takes_anything)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
