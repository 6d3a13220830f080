/* How long something took: count, extremes, mean, and a histogram with two buckets an octave. */
#ifndef FLOTILLA_STATISTICS_H
#define FLOTILLA_STATISTICS_H

#include <stdint.h>
#include <stdio.h>

enum { STATISTICS_BUCKETS = 80 };

struct statistics {
    uint64_t count;
    int64_t min_ns, max_ns, sum_ns;
    uint32_t histogram[STATISTICS_BUCKETS];
};

void statistics_add(struct statistics *statistics, int64_t ns);

/* The time below which `percent` of all lie, at the resolution of the histogram: its bucket's upper bound. */
int64_t statistics_percentile_ns(const struct statistics *statistics, double percent);

/* As a JSON object. */
void statistics_write(const struct statistics *statistics, FILE *out);

#endif
