/* Statistics of durations: count, extremes, mean, and a histogram with two buckets an octave. */
#ifndef FLOTILLA_STATISTICS_H
#define FLOTILLA_STATISTICS_H

#include <stdint.h>
#include <stdio.h>

enum { STATISTICS_BUCKETS = 80 };

struct statistics {
    uint64_t count;
    int64_t min_ns, max_ns, sum_ns;
    uint64_t histogram[STATISTICS_BUCKETS];
};

void statistics_add(struct statistics *statistics, int64_t ns);

/* The duration below which `percent` of all lie, rounded up to the upper bound of its bucket. */
int64_t statistics_percentile_ns(const struct statistics *statistics, double percent);

/* As a JSON object. */
void statistics_write(const struct statistics *statistics, FILE *out);

#endif
