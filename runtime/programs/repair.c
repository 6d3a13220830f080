#include "repair.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

/* One equation: the sum of these lost symbols is what `bytes` will be. */
struct equation {
    unsigned place; /* of the repair symbol */
    uint8_t *bytes; /* SYMBOL */
    uint64_t *lost; /* which lost symbols, by their order */
};

/* The finalizer of SplitMix64 over a counter: a word of a row. */
static uint64_t random_word(uint64_t counter)
{
    uint64_t word = (counter + 1) * UINT64_C(0x9e3779b97f4a7c15);
    word = (word ^ word >> 30) * UINT64_C(0xbf58476d1ce4e5b9);
    word = (word ^ word >> 27) * UINT64_C(0x94d049bb133111eb);
    return word ^ word >> 31;
}

void repair_row(unsigned number, uint64_t row[static WORDS])
{
    for (unsigned word = 0; word < WORDS; word++)
        row[word] = random_word((uint64_t)number * WORDS + word);
}

static bool bit(const uint64_t *bits, unsigned n)
{
    return bits[n / 64] >> n % 64 & 1;
}

static void add(uint64_t *to, const uint64_t *from, unsigned words)
{
    for (unsigned word = 0; word < words; word++)
        to[word] ^= from[word];
}

static void add_bytes(uint8_t *restrict to, const uint8_t *restrict from)
{
    for (unsigned n = 0; n < SYMBOL; n += 8) {
        uint64_t left, right;
        memcpy(&left, to + n, 8);
        memcpy(&right, from + n, 8);
        left ^= right;
        memcpy(to + n, &left, 8);
    }
}

/* The first of `count` equations from `from` on that has the lost symbol; `count` if none has. */
static unsigned find(struct equation *const *equations, unsigned from, unsigned count, unsigned symbol)
{
    while (from < count && !bit(equations[from]->lost, symbol))
        from++;
    return from;
}

/* Order equations so that the first ones are independent; returns how many are. Their coefficients change. */
static unsigned choose(struct equation **order, unsigned count, unsigned lost, unsigned words)
{
    unsigned rank = 0;
    for (unsigned symbol = 0; symbol < lost && rank < count; symbol++) {
        unsigned found = find(order, rank, count, symbol);
        if (found == count)
            continue;
        struct equation *pivot = order[found];
        order[found] = order[rank];
        order[rank++] = pivot;
        for (unsigned other = rank; other < count; other++)
            if (bit(order[other]->lost, symbol))
                add(order[other]->lost, pivot->lost, words);
    }
    return rank;
}

/* Gauss and Jordan: afterwards the equation in place n of `order` is lost symbol n. */
static void solve(struct equation **order, unsigned lost, unsigned words)
{
    for (unsigned symbol = 0; symbol < lost; symbol++) {
        unsigned found = find(order, symbol, lost, symbol);
        if (found == lost) /* never, for they are independent */
            return;
        struct equation *pivot = order[found];
        order[found] = order[symbol];
        order[symbol] = pivot;
        for (unsigned other = 0; other < lost; other++)
            if (other != symbol && bit(order[other]->lost, symbol)) {
                add(order[other]->lost, pivot->lost, words);
                add_bytes(order[other]->bytes, pivot->bytes);
            }
    }
}

/* Read the chosen repair symbols, and take from each what is there of the block. */
static bool read_repairs(const struct repair *repair, struct equation **order, unsigned lost)
{
    uint64_t row[WORDS];
    for (unsigned n = 0; n < lost; n++) {
        if (!repair->read(repair->context, order[n]->place, order[n]->bytes))
            return false;
        repair_row(repair->repairs[order[n]->place], row);
        for (unsigned symbol = 0; symbol < repair->symbols; symbol++)
            if (bit(row, symbol) && bit(repair->present, symbol))
                add_bytes(order[n]->bytes, repair->block + (size_t)symbol * SYMBOL);
    }
    return true;
}

/* What a repair works with. */
struct work {
    unsigned lost;                   /* symbols */
    uint16_t missing[BLOCK_SYMBOLS]; /* their numbers */
    unsigned words;                  /* of an equation */
    struct equation *equations, **order;
    uint64_t *bits, *kept; /* coefficients of all equations */
    uint8_t *bytes;        /* of the lost symbols */
};

/* One equation for each repair symbol. */
static void set_up(const struct repair *repair, struct work *work)
{
    uint64_t row[WORDS];
    for (unsigned n = 0; n < repair->count; n++) {
        uint64_t *lost = work->bits + (size_t)n * work->words;
        repair_row(repair->repairs[n], row);
        for (unsigned symbol = 0; symbol < work->lost; symbol++)
            if (bit(row, work->missing[symbol]))
                lost[symbol / 64] |= UINT64_C(1) << symbol % 64;
        work->equations[n] = (struct equation){.place = n, .lost = lost};
        work->order[n] = &work->equations[n];
    }
}

static int repair_with(const struct repair *repair, struct work *work)
{
    size_t size = (size_t)repair->count * work->words * sizeof *work->bits;
    set_up(repair, work);
    memcpy(work->kept, work->bits, size);
    unsigned rank = choose(work->order, repair->count, work->lost, work->words);
    memcpy(work->bits, work->kept, size);
    if (rank < work->lost)
        return (int)(work->lost - rank);
    for (unsigned n = 0; n < work->lost; n++)
        work->order[n]->bytes = work->bytes + (size_t)n * SYMBOL;
    if (!read_repairs(repair, work->order, work->lost))
        return -1;
    solve(work->order, work->lost, work->words);
    for (unsigned n = 0; n < work->lost; n++)
        memcpy(repair->block + (size_t)work->missing[n] * SYMBOL, work->order[n]->bytes, SYMBOL);
    return 0;
}

int repair(const struct repair *repair)
{
    struct work work = {0};
    int result = -1;
    for (unsigned symbol = 0; symbol < repair->symbols; symbol++)
        if (!bit(repair->present, symbol))
            work.missing[work.lost++] = (uint16_t)symbol;
    if (repair->count < work.lost)
        return (int)(work.lost - repair->count);
    if (work.lost == 0)
        return 0;
    work.words = (work.lost + 63) / 64;
    work.equations = calloc(repair->count, sizeof *work.equations);
    work.order = (struct equation **)calloc(repair->count, sizeof *work.order);
    work.bits = calloc((size_t)repair->count * work.words, sizeof *work.bits);
    work.kept = calloc((size_t)repair->count * work.words, sizeof *work.kept);
    work.bytes = calloc(work.lost, SYMBOL);
    if (work.equations && work.order && work.bits && work.kept && work.bytes)
        result = repair_with(repair, &work);
    int error = errno;
    free(work.equations);
    free((void *)work.order);
    free(work.bits);
    free(work.kept);
    free(work.bytes);
    errno = error;
    return result;
}
