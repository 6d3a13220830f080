#include "statistics.h"

#include <inttypes.h>

/* Bucket 2n holds [2^n, 1.5 * 2^n), bucket 2n+1 the rest of the octave. */
static unsigned bucket_of(int64_t ns)
{
    if (ns < 1)
        return 0;
    unsigned octave = 63u - (unsigned)__builtin_clzll((unsigned long long)ns);
    unsigned half = octave ? (unsigned)(ns >> (octave - 1)) & 1u : 0;
    unsigned bucket = 2 * octave + half;
    return bucket < STATISTICS_BUCKETS ? bucket : STATISTICS_BUCKETS - 1;
}

static int64_t upper_ns(unsigned bucket)
{
    int64_t octave = INT64_C(1) << (bucket / 2);
    return bucket % 2 ? 2 * octave : octave + octave / 2;
}

void statistics_add(struct statistics *statistics, int64_t ns)
{
    if (!statistics->count || ns < statistics->min_ns)
        statistics->min_ns = ns;
    if (!statistics->count || ns > statistics->max_ns)
        statistics->max_ns = ns;
    statistics->count++;
    statistics->sum_ns += ns;
    statistics->histogram[bucket_of(ns)]++;
}

int64_t statistics_percentile_ns(const struct statistics *statistics, double percent)
{
    double below = 0, wanted = (double)statistics->count * percent / 100;
    for (unsigned bucket = 0; bucket < STATISTICS_BUCKETS; bucket++) {
        below += (double)statistics->histogram[bucket];
        if (below >= wanted && below > 0)
            return upper_ns(bucket) < statistics->max_ns ? upper_ns(bucket) : statistics->max_ns;
    }
    return statistics->max_ns;
}

void statistics_write(const struct statistics *statistics, FILE *out)
{
    int64_t mean_ns = statistics->count ? statistics->sum_ns / (int64_t)statistics->count : 0;
    fprintf(out, "{\"count\": %" PRIu64 ", \"min_ns\": %" PRId64 ", \"mean_ns\": %" PRId64 ", \"max_ns\": %" PRId64,
            statistics->count, statistics->min_ns, mean_ns, statistics->max_ns);
    fprintf(out, ", \"p99_ns\": %" PRId64 "}", statistics_percentile_ns(statistics, 99));
}
