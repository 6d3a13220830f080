#include "seccomp.h"
#include "testbed.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "blocks/camera/spots.h"

enum { WIDTH = 160, HEIGHT = 120, DARK = 100 /* the threshold, as by default */ };

static uint8_t image[WIDTH * HEIGHT];
static struct spots_work work;

static void clear(void)
{
    memset(image, 0, sizeof image);
}

/* A spot as a lens makes it, added to what is there. */
static void shine(double column, double row, double peak, double sigma)
{
    for (int y = 0; y < HEIGHT; y++) {
        for (int x = 0; x < WIDTH; x++) {
            double square = (x - column) * (x - column) + (y - row) * (y - row);
            double value = image[y * WIDTH + x] + peak * exp(-square / (2 * sigma * sigma));
            image[y * WIDTH + x] = (uint8_t)lround(value > 255 ? 255 : value);
        }
    }
}

static void box(int left, int top, int right, int bottom, uint8_t value)
{
    for (int y = top; y <= bottom; y++)
        memset(&image[y * WIDTH + left], value, (size_t)(right - left + 1));
}

static int find(struct spot spots[SPOTS])
{
    return spots_find(&work, image, WIDTH, HEIGHT, DARK, 1, WIDTH * HEIGHT, spots);
}

/* --- the search --- */

static void nothing_on_black(void **state)
{
    (void)state;
    struct spot spots[SPOTS];
    clear();
    assert_int_equal(find(spots), 0);
    memset(image, DARK, sizeof image);
    assert_int_equal(find(spots), 0); /* the threshold itself is dark */
}

static void centres_to_a_fraction_of_a_pixel(void **state)
{
    (void)state;
    struct spot spots[SPOTS];
    for (int i = 0; i < 20; i++) {
        double column = 70.3 + 0.37 * i, row = 51.9 - 0.23 * i;
        clear();
        shine(column, row, 250, 2.5);
        assert_int_equal(find(spots), 1);
        assert_near(spots[0].column, column, 0.03);
        assert_near(spots[0].row, row, 0.03);
    }
}

/* Weights are the excess over the threshold: (51 * 10 + 101 * 11 + 1 * 12) / 153. */
static void weighs_by_brightness(void **state)
{
    (void)state;
    struct spot spots[SPOTS];
    clear();
    image[20 * WIDTH + 10] = DARK + 51;
    image[20 * WIDTH + 11] = DARK + 101;
    image[20 * WIDTH + 12] = DARK + 1;
    image[20 * WIDTH + 13] = DARK;
    assert_int_equal(find(spots), 1);
    assert_near(spots[0].column, 1633.0 / 153, 1e-12);
    assert_near(spots[0].row, 20, 1e-12);
    assert_int_equal(spots[0].weight, 153);
    assert_int_equal(spots[0].pixels, 3);
}

static void the_brightest_three_in_their_order(void **state)
{
    (void)state;
    struct spot spots[SPOTS];
    clear();
    shine(20, 20, 200, 2);
    shine(60, 20, 255, 2.5);
    shine(20, 60, 160, 2);
    shine(60, 60, 230, 2);
    shine(100, 100, 120, 2);
    assert_int_equal(find(spots), 3);
    const double places[3][2] = {{60, 20}, {60, 60}, {20, 20}};
    for (int i = 0; i < 3; i++) {
        assert_near(spots[i].column, places[i][0], 0.05);
        assert_near(spots[i].row, places[i][1], 0.05);
    }
    assert_true(spots[0].weight > spots[1].weight && spots[1].weight > spots[2].weight);
}

static void of_two_alike_the_upper_is_first(void **state)
{
    (void)state;
    struct spot spots[SPOTS];
    clear();
    box(80, 70, 82, 72, 200);
    box(20, 30, 22, 32, 200);
    box(50, 30, 52, 32, 200);
    box(5, 90, 7, 92, 200);
    assert_int_equal(find(spots), 3);
    assert_near(spots[0].column, 21, 1e-12);
    assert_near(spots[1].column, 51, 1e-12);
    assert_near(spots[2].column, 81, 1e-12);
}

/* What touches by side or corner is one spot; a dark pixel between them parts two. */
static void touching_spots_are_one(void **state)
{
    (void)state;
    struct spot spots[SPOTS];
    clear();
    box(10, 10, 19, 19, 200);
    box(20, 10, 29, 19, 200);
    assert_int_equal(find(spots), 1);
    assert_near(spots[0].column, 19.5, 1e-12);
    clear();
    box(10, 10, 19, 19, 200);
    box(20, 20, 29, 29, 200); /* right below */
    assert_int_equal(find(spots), 1);
    clear();
    box(20, 10, 29, 19, 200);
    box(10, 20, 19, 29, 200); /* left below */
    assert_int_equal(find(spots), 1);
    clear();
    box(10, 10, 19, 19, 200);
    box(21, 10, 30, 19, 200);
    box(10, 21, 19, 30, 200);
    assert_int_equal(find(spots), 3);
    clear();
    shine(50, 50, 200, 3);
    shine(62, 50, 200, 3); /* they overlap below the threshold only */
    assert_int_equal(find(spots), 2);
}

/* Regions that turn out to be one only further down, and in several steps. */
static void joins_what_meets_later(void **state)
{
    (void)state;
    struct spot spots[SPOTS];
    clear();
    for (int tooth = 0; tooth < 8; tooth++)
        box(10 + 4 * tooth, 10, 11 + 4 * tooth, 30, 200);
    box(10, 31, 39, 32, 200);
    assert_int_equal(find(spots), 1);
    assert_int_equal(spots[0].pixels, 8 * 2 * 21 + 30 * 2);
    assert_near(spots[0].column, 24.5, 1e-12);
    assert_near(spots[0].row, (336 * 20 + 60 * 31.5) / 396, 1e-12);
    clear(); /* a ring and a spot within */
    box(40, 40, 80, 80, 200);
    box(45, 45, 75, 75, 0);
    box(58, 58, 62, 62, 255);
    assert_int_equal(find(spots), 2);
    assert_near(spots[0].column, 60, 1e-12);
    assert_near(spots[1].row, 60, 1e-12);
    assert_int_equal(spots[0].pixels, 41 * 41 - 31 * 31);
}

static void reaches_the_border(void **state)
{
    (void)state;
    struct spot spots[SPOTS];
    clear();
    image[0] = 200;
    image[WIDTH - 1] = 220;
    image[WIDTH * HEIGHT - 1] = 240;
    assert_int_equal(find(spots), 3);
    assert_near(spots[0].column, WIDTH - 1, 0);
    assert_near(spots[0].row, HEIGHT - 1, 0);
    assert_near(spots[1].column, WIDTH - 1, 0);
    assert_near(spots[2].column, 0, 0);
    clear();
    box(WIDTH - 1, 10, WIDTH - 1, 11, 200); /* the end of a row is no neighbour of the next one's begin */
    box(0, 11, 0, 12, 200);
    assert_int_equal(find(spots), 2);
    memset(image, 255, sizeof image);
    assert_int_equal(find(spots), 1);
    assert_near(spots[0].column, (WIDTH - 1) / 2.0, 1e-9);
    assert_near(spots[0].row, (HEIGHT - 1) / 2.0, 1e-9);
}

static void noise_does_not_move_them(void **state)
{
    (void)state;
    struct spot spots[SPOTS];
    srand(7);
    for (int round = 0; round < 20; round++) {
        clear();
        shine(40.25, 30.5, 220, 3);
        shine(110.5, 90.75, 180, 3);
        for (int i = 0; i < WIDTH * HEIGHT; i++) {
            int noisy = image[i] + rand() % 31 - 15;
            image[i] = (uint8_t)(noisy < 0 ? 0 : noisy > 255 ? 255 : noisy);
        }
        for (int hot = 0; hot < 20; hot++) /* single hot pixels */
            image[(60 + hot) * WIDTH + 5 + 7 * hot % 30] = 255;
        int count = spots_find(&work, image, WIDTH, HEIGHT, DARK, 3, WIDTH * HEIGHT, spots);
        assert_int_equal(count, 2);
        assert_near(spots[0].column, 40.25, 0.3);
        assert_near(spots[0].row, 30.5, 0.3);
        assert_near(spots[1].column, 110.5, 0.3);
        assert_near(spots[1].row, 90.75, 0.3);
    }
}

static void leaves_out_by_size(void **state)
{
    (void)state;
    struct spot spots[SPOTS];
    clear();
    box(10, 10, 11, 11, 255); /* 4 pixels */
    box(30, 30, 32, 32, 200); /* 9 */
    box(60, 60, 69, 69, 200); /* 100: a lamp */
    assert_int_equal(spots_find(&work, image, WIDTH, HEIGHT, DARK, 5, 99, spots), 1);
    assert_near(spots[0].column, 31, 0);
    assert_int_equal(spots_find(&work, image, WIDTH, HEIGHT, DARK, 4, 100, spots), 3);
    assert_int_equal(spots_find(&work, image, WIDTH, HEIGHT, DARK, 101, 200, spots), 0);
}

/* However bright it is all over, the search is bounded, and says that this is no image of spots. */
static void gives_up_on_too_many(void **state)
{
    (void)state;
    struct spot spots[SPOTS];
    clear();
    for (int y = 0; y < HEIGHT; y += 2)
        for (int x = 0; x < WIDTH; x += 2)
            image[y * WIDTH + x] = 255;
    assert_int_equal(find(spots), -1);
}

/* Against a flood fill, which is slow and plain, on images of noise; rows that do not divide by eight, and thresholds
 * of both ways to skip the dark. */
static uint32_t flood(uint8_t *left, int width, int height, int x, int y, uint8_t threshold, uint64_t *weight)
{
    if (x < 0 || y < 0 || x >= width || y >= height || left[y * width + x] <= threshold)
        return 0;
    uint32_t pixels = 1;
    *weight += (uint64_t)(left[y * width + x] - threshold);
    left[y * width + x] = 0;
    for (int dy = -1; dy <= 1; dy++)
        for (int dx = -1; dx <= 1; dx++)
            pixels += flood(left, width, height, x + dx, y + dy, threshold, weight);
    return pixels;
}

static void agrees_with_a_flood_fill(void **state)
{
    (void)state;
    struct spot spots[SPOTS];
    srand(3);
    for (int round = 0; round < 2000; round++) {
        int width = 1 + rand() % 37, height = 1 + rand() % 20, density = rand() % 100;
        uint8_t threshold = (uint8_t)(rand() % 255), left[37 * 20];
        uint64_t best[SPOTS] = {0};
        int regions = 0;
        for (int i = 0; i < width * height; i++)
            image[i] = (uint8_t)(rand() % 100 < density ? rand() % 256 : rand() % (threshold + 1));
        memcpy(left, image, (size_t)(width * height));
        for (int i = 0; i < width * height; i++) {
            uint64_t weight = 0;
            if (!flood(left, width, height, i % width, i / width, threshold, &weight))
                continue;
            regions++;
            for (int at = 0; at < SPOTS; at++) {
                if (weight > best[at]) {
                    uint64_t lower = best[at];
                    best[at] = weight;
                    weight = lower;
                }
            }
        }
        int count = spots_find(&work, image, (size_t)width, (size_t)height, threshold, 1, 4096, spots);
        assert_int_equal(count, regions < SPOTS ? regions : SPOTS);
        for (int i = 0; i < count; i++)
            assert_int_equal(spots[i].weight, best[i]);
    }
}

/* --- the block --- */

static struct fl_block *processor(void)
{
    struct fl_block *block = testbed_block("image-processor", "width", "160", "height", "120", NULL);
    testbed_begin(block);
    return block;
}

static void show(struct fl_block *block, uint32_t sequence)
{
    memcpy(testbed_input(block, "image"), image, sizeof image);
    SET(block, "flag", uint8_t, 1);
    SET(block, "sequence", uint32_t, sequence);
    assert_int_equal(testbed_step(block), FL_OK);
}

static void normalises(void **state)
{
    (void)state;
    struct fl_block *block = processor();
    const double *x = testbed_output(block, "x"), *y = testbed_output(block, "y");
    clear();
    box(79, 59, 80, 60, 250); /* the four pixels around the centre */
    box(0, 0, 1, 1, 200);     /* and the upper left corner, whose centre is the border between its pixels */
    show(block, 1);
    assert_int_equal(GET(block, "flag", uint8_t), 1);
    assert_int_equal(GET(block, "count", uint8_t), 2);
    assert_near(x[0], 0, 1e-12);
    assert_near(y[0], 0, 1e-12);
    assert_near(x[1], 1.0 / 80 - 1, 1e-12);
    assert_near(y[1], 1.0 / 60 - 1, 1e-12);
    assert_near(((const double *)testbed_output(block, "brightness"))[1], 400, 0);
    assert_near(((const double *)testbed_output(block, "brightness"))[2], 0, 0);
    testbed_end(block);
}

static void flags_only_what_is_new(void **state)
{
    (void)state;
    struct fl_block *block = processor();
    assert_int_equal(testbed_step(block), FL_OK);
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    clear();
    shine(50, 50, 250, 2);
    SET(block, "age", double, 0.004);
    show(block, 7);
    assert_int_equal(GET(block, "flag", uint8_t), 1);
    assert_near(GET(block, "age", double), 0.004, 1e-8);
    double column = ((const double *)testbed_output(block, "x"))[0];
    clear();
    shine(90, 50, 250, 2);
    show(block, 7); /* the same number: it is not looked at again */
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    assert_near(GET(block, "age", double), 0.014, 1e-8);
    assert_int_equal(GET(block, "count", uint8_t), 1);
    assert_near(((const double *)testbed_output(block, "x"))[0], column, 0);
    SET(block, "flag", uint8_t, 0);
    SET(block, "sequence", uint32_t, 8);
    assert_int_equal(testbed_step(block), FL_OK); /* new, but not good */
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    show(block, 8);
    assert_int_equal(GET(block, "flag", uint8_t), 1);
    assert_int_equal(GET(block, "sequence", uint32_t), 2);
    clear();
    show(block, 9); /* good and new, but black */
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    assert_int_equal(GET(block, "count", uint8_t), 0);
    assert_int_equal(GET(block, "sequence", uint32_t), 2);
    for (int i = 0; i < WIDTH * HEIGHT; i++)
        image[i] = i / WIDTH % 2 || i % 2 ? 0 : 255;
    show(block, 10); /* and so many that none is a spot */
    assert_int_equal(GET(block, "flag", uint8_t), 0);
    assert_int_equal(GET(block, "count", uint8_t), 0);
    testbed_end(block);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("image-processor", "min_pixels", "9", "max_pixels", "8", NULL),
                           "min_pixels 9 is more than max_pixels 8"));
    assert_non_null(strstr(testbed_refusal("image-processor", "threshold", "255", NULL), "outside 0 to 254"));
}

static void steps_never_block(void **state)
{
    (void)state;
    struct fl_block *block = processor();
    steps_under_seccomp(block, 3);
    testbed_end(block);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(nothing_on_black),
        cmocka_unit_test(centres_to_a_fraction_of_a_pixel),
        cmocka_unit_test(weighs_by_brightness),
        cmocka_unit_test(the_brightest_three_in_their_order),
        cmocka_unit_test(of_two_alike_the_upper_is_first),
        cmocka_unit_test(touching_spots_are_one),
        cmocka_unit_test(joins_what_meets_later),
        cmocka_unit_test(reaches_the_border),
        cmocka_unit_test(noise_does_not_move_them),
        cmocka_unit_test(leaves_out_by_size),
        cmocka_unit_test(gives_up_on_too_many),
        cmocka_unit_test(agrees_with_a_flood_fill),
        cmocka_unit_test(normalises),
        cmocka_unit_test(flags_only_what_is_new),
        cmocka_unit_test(refuses),
        cmocka_unit_test(steps_never_block),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
