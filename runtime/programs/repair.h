/* Repair symbols of a block: sums modulo 2 of about half of its symbols, chosen at random (a random linear code over
 * GF(2)). Any n of them replace any n lost symbols; with a probability of 2^-m, m more are needed.
 *
 * flotilla/updates/multicast.py has the other end. */
#ifndef FLOTILLA_REPAIR_H
#define FLOTILLA_REPAIR_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    SYMBOL = 512,          /* bytes */
    BLOCK_SYMBOLS = 2048,  /* at most, in one block */
    REPAIRS_FROM = 0x0800, /* a symbol of that number or above is a repair symbol */
    LAST_REPAIR = 0xffff,  /* the highest number of a repair symbol */
    WORDS = BLOCK_SYMBOLS / 64,
};

_Static_assert(REPAIRS_FROM == BLOCK_SYMBOLS, "numbers below are the block's own symbols");

/* Which of a block's symbols repair symbol `number` is the sum of: bit n % 64 of word n / 64 stands for symbol n. */
void repair_row(unsigned number, uint64_t row[static WORDS]);

/* Get a repair symbol's bytes; false ends the repair. */
typedef bool repair_read(void *context, unsigned place, uint8_t bytes[static SYMBOL]);

struct repair {
    unsigned symbols;        /* of the block */
    uint8_t *block;          /* symbols × SYMBOL bytes; lost symbols hold anything */
    const uint64_t *present; /* as in a row: which symbols are there */
    const uint16_t *repairs; /* numbers of the repair symbols that are there, each once */
    unsigned count;
    repair_read *read; /* of the repair symbol in a place of `repairs` */
    void *context;
};

/* Put the lost symbols into the block. Returns 0, or how many more symbols it takes, or -1 with errno. */
int repair(const struct repair *repair);

#endif
