#include "testbed.h"

#include <inttypes.h>
#include <math.h>

static struct fl_block *begun(struct fl_block *block)
{
    testbed_begin(block);
    return block;
}

static void expect_bytes(struct fl_block *pack, const uint8_t *bytes, size_t count)
{
    assert_int_equal(testbed_step(pack), FL_OK);
    assert_int_equal(pack->out_ports[0].width, count);
    assert_memory_equal(testbed_output(pack, "out"), bytes, count);
}

/* Every type, by IEEE 754's and two's complement's bit patterns. */
#define ALL "boolean,int8,uint8,int16,uint16,int32,uint32,int64,uint64,single,double"

static void set_all(struct fl_block *pack)
{
    SET(pack, "in0", uint8_t, 1);
    SET(pack, "in1", int8_t, -2);
    SET(pack, "in2", uint8_t, 0xfd);
    SET(pack, "in3", int16_t, -0x1235);
    SET(pack, "in4", uint16_t, 0xabcd);
    SET(pack, "in5", int32_t, -2);
    SET(pack, "in6", uint32_t, 0x01020304);
    SET(pack, "in7", int64_t, INT64_MIN + 5);
    SET(pack, "in8", uint64_t, UINT64_C(0x0102030405060708));
    SET(pack, "in9", float, -2.5f);
    SET(pack, "in10", double, 1.0);
}

static const uint8_t all_little[] = {
    0x01, 0xfe, 0xfd, 0xcb, 0xed, 0xcd, 0xab, 0xfe, 0xff, 0xff, 0xff, 0x04,
    0x03, 0x02, 0x01, 0x05, 0,    0,    0,    0,    0,    0,    0x80,       /* int64 */
    0x08, 0x07, 0x06, 0x05, 0x04, 0x03, 0x02, 0x01,                         /* uint64 */
    0,    0,    0x20, 0xc0, 0,    0,    0,    0,    0,    0,    0xf0, 0x3f, /* single, double */
};
static const uint8_t all_big[] = {
    0x01, 0xfe, 0xfd, 0xed, 0xcb, 0xab, 0xcd, 0xff, 0xff, 0xff, 0xfe, 0x01,
    0x02, 0x03, 0x04, 0x80, 0,    0,    0,    0,    0,    0,    0x05,    /* int64 */
    0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08,                      /* uint64 */
    0xc0, 0x20, 0,    0,    0x3f, 0xf0, 0,    0,    0,    0,    0,    0, /* single, double */
};

static void packs_all_types(void **state)
{
    (void)state;
    struct fl_block *little = begun(testbed_block("pack", "types", ALL, NULL));
    struct fl_block *big = begun(testbed_block("pack", "types", ALL, "byte_order", "big", NULL));
    set_all(little);
    set_all(big);
    expect_bytes(little, all_little, sizeof all_little);
    expect_bytes(big, all_big, sizeof all_big);
    testbed_end(little);
    testbed_end(big);
}

/* The example of the xPC Target I/O User's Guide: with alignment 4 the signals begin at 0, 4, 8, 12, 16. */
static void aligns_as_simulink(void **state)
{
    (void)state;
    struct fl_block *pack =
        begun(testbed_block("pack", "types", "uint8,uint32,single,int16,double", "alignment", "4", NULL));
    static const uint8_t bytes[] = {0xff, 0,    0, 0, 4, 3, 2, 1, 0, 0, 0x80, 0x3f,
                                    0x34, 0x12, 0, 0, 0, 0, 0, 0, 0, 0, 0,    0x40};
    SET(pack, "in0", uint8_t, 0xff);
    SET(pack, "in1", uint32_t, 0x01020304);
    SET(pack, "in2", float, 1);
    SET(pack, "in3", int16_t, 0x1234);
    SET(pack, "in4", double, 2);
    expect_bytes(pack, bytes, sizeof bytes);
    testbed_end(pack);
    static const struct {
        const char *alignment;
        uint32_t bytes;
    } sizes[] = {{"1", 19}, {"2", 20}, {"4", 24}, {"8", 40}};
    for (size_t i = 0; i < 4; i++) {
        pack =
            testbed_block("pack", "types", "uint8,uint32,single,int16,double", "alignment", sizes[i].alignment, NULL);
        assert_int_equal(pack->out_ports[0].width, sizes[i].bytes);
        testbed_end(pack);
    }
}

/* Elements of one signal lie side by side, whatever the alignment. */
static void packs_wide_signals(void **state)
{
    (void)state;
    struct fl_block *pack = begun(testbed_block("pack", "types", "uint16,boolean", "widths", "3,2", "names", "words,on",
                                                "alignment", "4", "byte_order", "big", NULL));
    static const uint8_t bytes[] = {0x12, 0x34, 0x56, 0x78, 0x9a, 0xbc, 0, 0, 0, 1};
    memcpy(testbed_input(pack, "words"), (const uint16_t[]){0x1234, 0x5678, 0x9abc}, 6);
    memcpy(testbed_input(pack, "on"), (const uint8_t[]){0, 0xff}, 2);
    expect_bytes(pack, bytes, sizeof bytes);
    testbed_end(pack);
}

static void unpacks_all_types(void **state)
{
    (void)state;
    for (int big = 0; big < 2; big++) {
        struct fl_block *unpack =
            begun(testbed_block("unpack", "types", ALL, "byte_order", big ? "big" : "little", NULL));
        memcpy(testbed_input(unpack, "in"), big ? all_big : all_little, sizeof all_big);
        ((uint8_t *)testbed_input(unpack, "in"))[0] = 0x40; /* a true of others' */
        assert_int_equal(testbed_step(unpack), FL_OK);
        assert_int_equal(GET(unpack, "flag", uint8_t), 1);
        assert_int_equal(GET(unpack, "out0", uint8_t), 1);
        assert_int_equal(GET(unpack, "out1", int8_t), -2);
        assert_int_equal(GET(unpack, "out2", uint8_t), 0xfd);
        assert_int_equal(GET(unpack, "out3", int16_t), -0x1235);
        assert_int_equal(GET(unpack, "out4", uint16_t), 0xabcd);
        assert_int_equal(GET(unpack, "out5", int32_t), -2);
        assert_int_equal(GET(unpack, "out6", uint32_t), 0x01020304);
        assert_true(GET(unpack, "out7", int64_t) == INT64_MIN + 5);
        assert_true(GET(unpack, "out8", uint64_t) == UINT64_C(0x0102030405060708));
        assert_near(GET(unpack, "out9", float), -2.5, 0);
        assert_near(GET(unpack, "out10", double), 1, 0);
        testbed_end(unpack);
    }
}

/* What was packed comes back, NaN and infinity included, also with gaps and more bytes than needed. */
static void returns_what_was_packed(void **state)
{
    (void)state;
    struct fl_block *pack = begun(testbed_block("pack", "types", "uint8,double,single", "widths", "3,2,1", "alignment",
                                                "8", "byte_order", "big", NULL));
    struct fl_block *unpack = begun(testbed_block("unpack", "types", "uint8,double,single", "widths", "3,2,1",
                                                  "alignment", "8", "byte_order", "big", "size", "64", NULL));
    const double values[] = {NAN, -INFINITY};
    memcpy(testbed_input(pack, "in1"), values, sizeof values);
    memcpy(testbed_input(pack, "in0"), "abc", 3);
    SET(pack, "in2", float, 1e-40f); /* subnormal */
    testbed_step(pack);
    assert_int_equal(unpack->in_ports[0].width, 64);
    memcpy(testbed_input(unpack, "in"), testbed_output(pack, "out"), pack->out_ports[0].width);
    testbed_step(unpack);
    assert_memory_equal(testbed_output(unpack, "out0"), "abc", 3);
    assert_memory_equal(testbed_output(unpack, "out1"), values, sizeof values);
    assert_true(GET(unpack, "out2", float) == 1e-40f);
    testbed_end(pack);
    testbed_end(unpack);
}

static void checks_the_length(void **state)
{
    (void)state;
    struct fl_block *unpack =
        begun(testbed_block("unpack", "types", "int16", "check_length", "true", "size", "4", "names", "value", NULL));
    memcpy(testbed_input(unpack, "in"), (const uint8_t[]){5, 0, 9, 9}, 4);
    SET(unpack, "length", uint32_t, 2);
    testbed_step(unpack);
    assert_int_equal(GET(unpack, "flag", uint8_t), 1);
    assert_int_equal(GET(unpack, "value", int16_t), 5);
    const uint32_t wrong[] = {0, 1, 3, 4, UINT32_MAX};
    for (size_t i = 0; i < 5; i++) {
        memcpy(testbed_input(unpack, "in"), (const uint8_t[]){6, 0, 9, 9}, 4);
        SET(unpack, "length", uint32_t, wrong[i]);
        testbed_step(unpack);
        assert_int_equal(GET(unpack, "flag", uint8_t), 0);
        assert_int_equal(GET(unpack, "value", int16_t), 5);
    }
    testbed_end(unpack);
}

static void refuses(void **state)
{
    (void)state;
    assert_non_null(strstr(testbed_refusal("pack", "types", "double,float", NULL), "types: there is no type float"));
    assert_non_null(strstr(testbed_refusal("pack", "types", "double", "widths", "1,2", NULL), "2 widths for 1 types"));
    assert_non_null(
        strstr(testbed_refusal("pack", "types", "double", "widths", "1.5", NULL), "1.5 is not a whole number"));
    assert_non_null(strstr(testbed_refusal("pack", "types", "double", "widths", "0", NULL), "0 is outside 1 to 65536"));
    assert_non_null(
        strstr(testbed_refusal("pack", "types", "double", "widths", "9000", NULL), "72000 bytes are more than 65507"));
    assert_non_null(strstr(testbed_refusal("pack", "types", "int8,int8", "names", "a", NULL), "1 names for 2 types"));
    assert_non_null(
        strstr(testbed_refusal("pack", "types", "int8,int8", "names", "a,a", NULL), "there is a port a already"));
    assert_non_null(strstr(testbed_refusal("pack", "types", "int8", "names", "a.b", NULL), "names: \"a.b\" is not"));
    assert_non_null(
        strstr(testbed_refusal("pack", "types", "int8", "alignment", "3", NULL), "3 is not one of 1|2|4|8"));
    assert_non_null(
        strstr(testbed_refusal("unpack", "types", "int8", "names", "flag", NULL), "there is a port flag already"));
    assert_non_null(
        strstr(testbed_refusal("unpack", "types", "double", "size", "7", NULL), "size: the signals need 8 bytes"));
    assert_non_null(strstr(testbed_refusal("unpack", NULL), "parameter types of unpack is missing"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(packs_all_types),
        cmocka_unit_test(aligns_as_simulink),
        cmocka_unit_test(packs_wide_signals),
        cmocka_unit_test(unpacks_all_types),
        cmocka_unit_test(returns_what_was_packed),
        cmocka_unit_test(checks_the_length),
        cmocka_unit_test(refuses),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
