#include "testbed.h"

#include <flotilla/sensor.h>

enum { FLAG, AGE, SEQUENCE };
static const int64_t MS = 1000 * 1000;

/* A block's outputs without a block. */
struct outputs {
    bool flag;
    double age;
    uint32_t sequence;
};

static struct outputs outputs_at(struct fl_sensor *sensor, int64_t release_ns, bool there)
{
    struct outputs outputs;
    void *const out[] = {[FLAG] = &outputs.flag, [AGE] = &outputs.age, [SEQUENCE] = &outputs.sequence};
    struct fl_block block = {.out = out, .out_count = 3, .release_ns = release_ns};
    fl_sensor_outputs(sensor, &block, FLAG, there, 0.1);
    return outputs;
}

static void is_bad_until_the_first_value(void **state)
{
    (void)state;
    struct fl_sensor sensor;
    int64_t begin_ns = fl_now_ns();
    fl_sensor_begin(&sensor);
    struct outputs outputs = outputs_at(&sensor, begin_ns + 2000 * MS, true);
    assert_false(outputs.flag);
    assert_true(outputs.age > 0 && outputs.age <= 2);
    assert_int_equal(outputs.sequence, 0);
}

static void ages_and_is_good_up_to_the_timeout(void **state)
{
    (void)state;
    struct fl_sensor sensor;
    fl_sensor_begin(&sensor);
    fl_sensor_update(&sensor, 1000 * MS, 7);
    static const struct {
        int64_t release_ns;
        double age;
        bool flag;
    } cases[] = {
        {990 * MS, 0, true}, /* it came after the release of the step that sees it */
        {1000 * MS, 0, true},
        {1100 * MS, 0.1, true},
        {1100 * MS + 1, 0.1, false},
    };
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        struct outputs outputs = outputs_at(&sensor, cases[i].release_ns, true);
        assert_near(outputs.age, cases[i].age, 1e-8);
        assert_int_equal(outputs.flag, cases[i].flag);
        assert_int_equal(outputs.sequence, 7);
    }
}

static void a_bad_measurement_moves_neither_age_nor_sequence(void **state)
{
    (void)state;
    struct fl_sensor sensor;
    fl_sensor_begin(&sensor);
    fl_sensor_update(&sensor, 1000 * MS, 1);
    fl_sensor_invalidate(&sensor);
    struct outputs outputs = outputs_at(&sensor, 1010 * MS, true);
    assert_false(outputs.flag);
    assert_near(outputs.age, 0.01, 1e-12);
    assert_int_equal(outputs.sequence, 1);
    fl_sensor_update(&sensor, 1010 * MS, 3);
    outputs = outputs_at(&sensor, 1010 * MS, true);
    assert_true(outputs.flag);
    assert_int_equal(outputs.sequence, 3);
}

static void what_came_before_the_source_was_gone_is_never_good_again(void **state)
{
    (void)state;
    struct fl_sensor sensor;
    fl_sensor_begin(&sensor);
    fl_sensor_update(&sensor, 1000 * MS, 1);
    assert_false(outputs_at(&sensor, 1000 * MS, false).flag);
    assert_false(outputs_at(&sensor, 1000 * MS, true).flag);
    fl_sensor_update(&sensor, 1000 * MS, 2);
    assert_true(outputs_at(&sensor, 1000 * MS, true).flag);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(is_bad_until_the_first_value),
        cmocka_unit_test(ages_and_is_good_up_to_the_timeout),
        cmocka_unit_test(a_bad_measurement_moves_neither_age_nor_sequence),
        cmocka_unit_test(what_came_before_the_source_was_gone_is_never_good_again),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
