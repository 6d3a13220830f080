#include "spots.h"

#include <string.h>

static uint16_t root(struct spots_region *regions, uint16_t region)
{
    while (regions[region].parent != region) {
        regions[region].parent = regions[regions[region].parent].parent; /* halve the path */
        region = regions[region].parent;
    }
    return region;
}

static uint16_t join(struct spots_region *regions, uint16_t left, uint16_t right)
{
    left = root(regions, left);
    right = root(regions, right);
    if (left == right)
        return left;
    uint16_t low = left < right ? left : right, high = left < right ? right : left;
    regions[high].parent = low;
    regions[low].pixels += regions[high].pixels;
    regions[low].weight += regions[high].weight;
    regions[low].column_moment += regions[high].column_moment;
    regions[low].row_moment += regions[high].row_moment;
    return low;
}

/* The first column from `column` on whose pixel is brighter than the threshold. Almost all of an image is black, so
 * this is where the time goes: eight pixels at once where they lie below. */
static size_t skip_dark(const uint8_t *row, size_t column, size_t width, uint8_t threshold)
{
    const uint64_t ones = UINT64_C(0x0101010101010101), highs = ones << 7;
    if (threshold < 0x80) {
        const uint64_t lift = ones * (uint64_t)(0x7F - threshold); /* carries into bit 7 of what exceeds it */
        for (uint64_t pixels; column + sizeof pixels <= width; column += sizeof pixels) {
            memcpy(&pixels, row + column, sizeof pixels);
            if ((((pixels & ~highs) + lift) | pixels) & highs)
                break;
        }
    }
    while (column < width && row[column] <= threshold)
        column++;
    return column;
}

static void add_run(struct spots_region *region, const uint8_t *pixels, size_t row, size_t begin, size_t end,
                    uint8_t threshold)
{
    uint32_t weight = 0;
    uint64_t moment = 0;
    for (size_t column = begin; column < end; column++) {
        uint32_t excess = (uint32_t)(pixels[column] - threshold);
        weight += excess;
        moment += excess * column;
    }
    region->pixels += (uint32_t)(end - begin);
    region->weight += weight;
    region->column_moment += moment;
    region->row_moment += (uint64_t)weight * row;
}

/* The brightest first; of two alike the one that begins further up. */
static int insert(struct spot spots[SPOTS], int count, struct spot spot)
{
    int at = count;
    while (at > 0 && spots[at - 1].weight < spot.weight)
        at--;
    if (at == SPOTS)
        return count;
    int last = count < SPOTS ? count : SPOTS - 1;
    for (int i = last; i > at; i--)
        spots[i] = spots[i - 1];
    spots[at] = spot;
    return last + 1;
}

int spots_find(struct spots_work *work, const uint8_t *image, size_t width, size_t height, uint8_t threshold,
               uint32_t min_pixels, uint32_t max_pixels, struct spot spots[SPOTS])
{
    struct spots_region *regions = work->regions;
    size_t region_count = 0, above_count = 0;
    for (size_t row = 0; row < height; row++) {
        const uint8_t *pixels = image + row * width;
        const struct spots_run *above = work->runs[(row + 1) % 2];
        struct spots_run *runs = work->runs[row % 2];
        size_t count = 0, next_above = 0;
        for (size_t begin, end = 0; (begin = skip_dark(pixels, end, width, threshold)) < width; count++) {
            for (end = begin; end < width && pixels[end] > threshold;)
                end++;
            /* Those that end before this begins, a corner apart included, touch nothing further right either. */
            while (next_above < above_count && above[next_above].end < begin)
                next_above++;
            bool found = false;
            uint16_t region = 0;
            for (size_t i = next_above; i < above_count && above[i].begin <= end; i++) {
                region = found ? join(regions, region, above[i].region) : root(regions, above[i].region);
                found = true;
            }
            if (!found) {
                if (region_count == SPOTS_REGIONS)
                    return -1;
                region = (uint16_t)region_count++;
                regions[region] = (struct spots_region){.parent = region};
            }
            add_run(&regions[region], pixels, row, begin, end, threshold);
            runs[count] = (struct spots_run){(uint16_t)begin, (uint16_t)end, region};
        }
        above_count = count;
    }
    int found = 0;
    for (size_t i = 0; i < region_count; i++) {
        const struct spots_region *region = &regions[i];
        if (region->parent != i || region->pixels < min_pixels || region->pixels > max_pixels)
            continue;
        double weight = (double)region->weight;
        found = insert(spots, found,
                       (struct spot){.column = (double)region->column_moment / weight,
                                     .row = (double)region->row_moment / weight,
                                     .weight = region->weight,
                                     .pixels = region->pixels});
    }
    return found;
}
