/** image-processor
 *
 * Finds up to three bright spots in an image that is otherwise black, and where they are.
 *
 * Equations:
 *   a spot: pixels brighter than `threshold` that touch by side or corner, `min_pixels` to `max_pixels` of them
 *   brightness = Σ (pixel − threshold)
 *   column, row = Σ (pixel − threshold)·(its column, row)/brightness
 *   x = (2·column + 1)/width − 1,  y = (2·row + 1)/height − 1
 *
 * Failure: The flag is 1 only in a step that saw a new and good image with a spot in it. Without a new image all
 * values stay. A new image without a spot, or with more than 1024 regions, gives `count` 0 and zeros; `age` then goes
 * on growing.
 */
#include "spots.h"

#include <flotilla/block.h>
#include <string.h>

struct image_processor {
    int64_t width, height, threshold, min_pixels, max_pixels;
};

struct state {
    struct spots_work work;
    uint32_t seen; /* sequence of the last image */
    uint32_t sequence;
    int64_t taken_ns; /* when the last image with spots was taken */
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct image_processor, width, .default_value = "640", .min = 1, .max = SPOTS_SIDE, .unit = "pixel",
                 .summary = "of the image"),
    FL_PARAMETER(struct image_processor, height, .default_value = "480", .min = 1, .max = SPOTS_SIDE, .unit = "pixel",
                 .summary = "of the image"),
    FL_PARAMETER(struct image_processor, threshold, .flags = FL_TUNABLE, .default_value = "100", .min = 0, .max = 254,
                 .summary = "a spot's pixels are brighter than this; below 128 it takes the least time"),
    FL_PARAMETER(struct image_processor, min_pixels, .flags = FL_TUNABLE, .default_value = "3", .min = 1,
                 .max = 4194304, .unit = "pixel", .summary = "smaller regions are noise"),
    FL_PARAMETER(struct image_processor, max_pixels, .flags = FL_TUNABLE, .default_value = "4194304", .min = 1,
                 .max = 4194304, .unit = "pixel", .summary = "larger regions are no spots"),
};

enum { IMAGE, GOOD, NUMBER, IMAGE_AGE };
enum { COUNT, X, Y, BRIGHTNESS, FLAG, AGE, SEQUENCE };
static const struct fl_port outputs[] = {
    {.name = "count", .type = FL_UINT8, .width = 1, .summary = "spots found, three at most"},
    {.name = "x",
     .type = FL_DOUBLE,
     .width = SPOTS,
     .summary = "of their centres, the brightest first: -1 at the left edge of the image, 1 at the right"},
    {.name = "y",
     .type = FL_DOUBLE,
     .width = SPOTS,
     .summary = "of their centres: -1 at the upper edge, 1 at the lower"},
    {.name = "brightness",
     .type = FL_DOUBLE,
     .width = SPOTS,
     .summary = "sum of what their pixels exceed the threshold by; 0 where there is no spot"},
    {.name = "flag", .type = FL_BOOLEAN, .width = 1, .summary = "1: this step saw a new image, and spots in it"},
    {.name = "age", .type = FL_DOUBLE, .width = 1, .unit = "s", .summary = "time since that image was taken"},
    {.name = "sequence", .type = FL_UINT32, .width = 1, .summary = "images with spots so far"},
};

static int configure(struct fl_block *block)
{
    const struct image_processor *set = block->parameters;
    const struct fl_port inputs[] = {
        {.name = "image",
         .type = FL_UINT8,
         .width = (uint32_t)(set->width * set->height),
         .summary = "brightness of its pixels, row by row from the top left"},
        {.name = "flag", .type = FL_BOOLEAN, .width = 1, .summary = "1: the image is good"},
        {.name = "sequence", .type = FL_UINT32, .width = 1, .summary = "changes with each new image"},
        {.name = "age",
         .type = FL_DOUBLE,
         .width = 1,
         .flags = FL_OPTIONAL,
         .unit = "s",
         .summary = "time since the image was taken"},
    };
    for (size_t i = 0; i < sizeof inputs / sizeof inputs[0]; i++)
        if (fl_add_input(block, inputs[i]) != FL_OK)
            return FL_FAILED;
    if (set->min_pixels > set->max_pixels)
        return fl_fail(block, "min_pixels %d is more than max_pixels %d", (int)set->min_pixels, (int)set->max_pixels);
    return FL_OK;
}

static int initialize(struct fl_block *block)
{
    struct state *state = block->state;
    state->taken_ns = block->release_ns;
    return FL_OK;
}

/* Pixel 0 begins at -1 and the last one ends at 1. */
static double normalised(double pixel, int64_t side)
{
    return (2 * pixel + 1) / (double)side - 1;
}

static void show(struct fl_block *block, const struct spot *spots, int count)
{
    const struct image_processor *set = block->parameters;
    double *x = block->out[X], *y = block->out[Y], *brightness = block->out[BRIGHTNESS];
    for (int i = 0; i < SPOTS; i++) {
        bool found = i < count;
        x[i] = found ? normalised(spots[i].column, set->width) : 0;
        y[i] = found ? normalised(spots[i].row, set->height) : 0;
        brightness[i] = found ? (double)spots[i].weight : 0;
    }
    FL_OUT(block, COUNT, uint8_t) = (uint8_t)count;
}

static int step(struct fl_block *block)
{
    const struct image_processor *set = block->parameters;
    struct state *state = block->state;
    uint32_t number = FL_IN(block, NUMBER, uint32_t);
    bool fresh = FL_IN(block, GOOD, uint8_t) && number != state->seen;
    int count = 0;
    if (fresh) {
        struct spot spots[SPOTS];
        state->seen = number;
        count = spots_find(&state->work, block->in[IMAGE], (size_t)set->width, (size_t)set->height,
                           (uint8_t)set->threshold, (uint32_t)set->min_pixels, (uint32_t)set->max_pixels, spots);
        show(block, spots, count < 0 ? 0 : count);
    }
    if (count > 0) {
        state->sequence++;
        state->taken_ns = block->release_ns - (int64_t)(FL_IN(block, IMAGE_AGE, double) * 1e9);
    }
    FL_OUT(block, FLAG, uint8_t) = count > 0;
    FL_OUT(block, AGE, double) = (double)(block->release_ns - state->taken_ns) * 1e-9;
    FL_OUT(block, SEQUENCE, uint32_t) = state->sequence;
    return FL_OK;
}

FL_BLOCK(image_processor) = {
    .abi = FL_ABI,
    .name = "image-processor",
    .summary = "up to three bright spots on black",
    .source = "Rosenfeld and Pfaltz, J. ACM 13(4), 1966: connected regions",
    FL_TABLE(output, outputs),
    FL_TABLE(parameter, parameters),
    .parameters_size = sizeof(struct image_processor),
    .state_size = sizeof(struct state),
    .configure = configure,
    .initialize = initialize,
    .step = step,
};
