/* The engine against a drive of few lines: what the engine sends, in which order, and what it makes of the answers.
 * flotilla/lab/emulators/epos2.py is the complete drive, which the block is tested against. */
#include "blocks/can/epos2.h"
#include "testbed.h"

#include <math.h>
#include <stdlib.h>

enum { NODE = 5, PERIOD_MS = 10, CONTACT = 80 /* periods in which a drive is configured and enabled */ };
#define MS INT64_C(1000000)

/* --- a drive that executes its commands --- */

struct stub {
    struct epos2 engine;
    struct epos2_command command;
    int64_t now_ns;
    int64_t lossy_ns, beat_ns; /* from one of the drive's heartbeats to the next that is not lost; 0: each arrives */
    bool present, operational, answers, moves_on; /* moves_on: its axis obeys the control word */
    struct can_frame sent[EPOS2_FRAMES];
    size_t sent_count;
    uint32_t objects[1024]; /* of the SDOs: index << 8 | sub, and value, in turn */
    size_t object_count;
    uint32_t refuse;                           /* the object that it aborts */
    uint16_t control, words[64], status, bits; /* bits: of the status word, beside its state */
    size_t word_count;
    int8_t mode;
    int32_t target, counts, rpm;
    int16_t ma;
};

static const struct epos2_settings usual = {
    .node = NODE,
    .master = 127,
    .mode = EPOS2_VELOCITY,
    .heartbeat_ms = 100,
    .counts_per_rad = 100,
    .rpm_per_rad_s = 10,
};

static void deliver(struct stub *stub, uint32_t id, size_t length, const void *data)
{
    struct can_frame frame = {.can_id = id};
    frame.len = (uint8_t)length;
    memcpy(frame.data, data, length);
    epos2_receive(&stub->engine, &frame, stub->now_ns);
}

static const uint32_t *object(const struct stub *stub, uint32_t name)
{
    for (size_t i = stub->object_count; i >= 2; i -= 2)
        if (stub->objects[i - 2] == name)
            return &stub->objects[i - 1];
    return NULL;
}

static bool on(const struct stub *stub, uint32_t pdo)
{
    const uint32_t *cob = object(stub, pdo << 8 | 1);
    return cob && !(*cob & 0x80000000);
}

static void answer_sdo(struct stub *stub, const uint8_t *request)
{
    uint8_t answer[8] = {0x60, request[1], request[2], request[3]};
    uint32_t name = (uint32_t)(request[2] << 16 | request[1] << 8 | request[3]);
    uint32_t value =
        (uint32_t)request[4] | (uint32_t)request[5] << 8 | (uint32_t)request[6] << 16 | (uint32_t)request[7] << 24;
    if (!stub->answers)
        return;
    if (name == stub->refuse) {
        memcpy(answer, (uint8_t[]){0x80, request[1], request[2], request[3], 0x00, 0x00, 0x02, 0x06}, 8);
    } else {
        assert_true(stub->object_count + 2 <= 1024);
        stub->objects[stub->object_count++] = name;
        stub->objects[stub->object_count++] = value;
        if (name == 0x606000)
            stub->mode = (int8_t)value;
    }
    deliver(stub, 0x580 + NODE, 8, answer);
}

static void obey(struct stub *stub, uint16_t word)
{
    bool rising = word & 0x80 && !(stub->control & 0x80);
    stub->control = word;
    if (stub->word_count == 0 || stub->words[stub->word_count - 1] != word) {
        assert_true(stub->word_count < 64);
        stub->words[stub->word_count++] = word;
    }
    if (!stub->moves_on)
        return;
    if (stub->status == 0x0008)
        stub->status = rising ? 0x0040 : 0x0008;
    else if (!(word & 2))
        stub->status = 0x0040;
    else if (!(word & 4))
        stub->status = stub->status == 0x0027 ? 0x0007 : stub->status == 0x0007 ? 0x0007 : 0x0040;
    else if (stub->status == 0x0040 && (word & 7) == 6)
        stub->status = 0x0021;
    else if (stub->status == 0x0021 && (word & 15) == 7)
        stub->status = 0x0023;
    else if (stub->status == 0x0023 && (word & 15) == 15)
        stub->status = 0x0027;
}

static void report(struct stub *stub)
{
    uint16_t s = stub->status | stub->bits;
    uint8_t low = (uint8_t)s, high = (uint8_t)(s >> 8);
    uint32_t p = (uint32_t)stub->counts, v = (uint32_t)stub->rpm;
    uint16_t i = (uint16_t)stub->ma;
    if (on(stub, 0x1801))
        deliver(stub, 0x280 + NODE, 3, (uint8_t[]){low, high, (uint8_t)stub->mode});
    if (on(stub, 0x1802))
        deliver(stub, 0x380 + NODE, 6,
                (uint8_t[]){low, high, (uint8_t)p, (uint8_t)(p >> 8), (uint8_t)(p >> 16), (uint8_t)(p >> 24)});
    if (on(stub, 0x1803))
        deliver(stub, 0x480 + NODE, 8,
                (uint8_t[]){low, high, (uint8_t)v, (uint8_t)(v >> 8), (uint8_t)(v >> 16), (uint8_t)(v >> 24),
                            (uint8_t)i, (uint8_t)(i >> 8)});
}

static void take(struct stub *stub, const struct can_frame *frame)
{
    if (frame->can_id == 0 && frame->data[1] == NODE) {
        stub->operational = frame->data[0] == 1;
        if (frame->data[0] == 0x82) {
            stub->object_count = 0;
            deliver(stub, 0x700 + NODE, 1, "\x00");
        }
    } else if (frame->can_id == 0x600 + NODE) {
        answer_sdo(stub, frame->data);
    } else if (frame->can_id == 0x500 + NODE && stub->operational && on(stub, 0x1403)) {
        memcpy(&stub->target, frame->data + 2, 4);
        if (frame->len == 7)
            stub->mode = (int8_t)frame->data[6];
        obey(stub, (uint16_t)(frame->data[0] | frame->data[1] << 8));
    } else if (frame->can_id == 0x080 && stub->operational) {
        report(stub);
    }
}

/* One period: the engine sends, the drive receives it and answers. */
static void period(struct stub *stub)
{
    stub->now_ns += PERIOD_MS * MS;
    stub->command.sync = true;
    stub->sent_count = epos2_advance(&stub->engine, stub->now_ns, &stub->command, stub->sent);
    assert_true(stub->sent_count <= EPOS2_FRAMES);
    if (!stub->present)
        return;
    if (stub->now_ns - stub->beat_ns >= stub->lossy_ns) {
        stub->beat_ns = stub->now_ns;
        deliver(stub, 0x700 + NODE, 1, stub->operational ? "\x05" : "\x7F");
    }
    for (size_t i = 0; i < stub->sent_count; i++)
        take(stub, &stub->sent[i]);
}

static void periods(struct stub *stub, int count)
{
    for (int i = 0; i < count; i++)
        period(stub);
}

static struct stub *make(struct epos2_settings settings)
{
    struct stub *stub = test_calloc(1, sizeof *stub);
    *stub = (struct stub){.present = true, .answers = true, .moves_on = true, .status = 0x0040, .now_ns = 1000 * MS};
    epos2_begin(&stub->engine, &settings);
    return stub;
}

static struct stub *enabled(struct epos2_settings settings)
{
    struct stub *stub = make(settings);
    stub->command = (struct epos2_command){.enable = true};
    periods(stub, CONTACT);
    assert_true(epos2_enabled(&stub->engine));
    stub->word_count = 0;
    return stub;
}

/* A drive that is to search its home by an end stop, and has begun. */
static struct stub *searching(bool automatic_restart)
{
    struct epos2_settings settings = usual;
    settings.mode = EPOS2_POSITION;
    settings.homing_method = -4;
    settings.homing_rpm = 200;
    settings.homing_ma = 900;
    settings.homing_offset = 60;
    settings.homing_ns = 2000 * MS;
    settings.automatic_restart = automatic_restart;
    struct stub *stub = make(settings);
    stub->counts = 4321;
    stub->command = (struct epos2_command){.enable = false, .target = 5};
    periods(stub, CONTACT);
    assert_int_equal(stub->words[stub->word_count - 1], 0); /* not before it is enabled */
    stub->word_count = 0;
    stub->command.enable = true;
    periods(stub, 10);
    return stub;
}

/* --- tests --- */

static void searches_its_home_first(void **state)
{
    (void)state;
    struct stub *stub = searching(false);
    const uint16_t way[] = {0x0006, 0x0007, 0x000F, 0x001F};
    assert_int_equal(*object(stub, 0x609800), 0xFC);
    assert_int_equal(*object(stub, 0x609901), 200);
    assert_int_equal(*object(stub, 0x609902), 200);
    assert_int_equal(*object(stub, 0x208000), 900);
    assert_int_equal(*object(stub, 0x607C00), 60);
    assert_int_equal(*object(stub, 0x160303), 0x60600008);
    assert_int_equal(stub->word_count, 4);
    assert_memory_equal(stub->words, way, sizeof way);
    assert_int_equal(stub->mode, 6);
    periods(stub, 50);
    assert_int_equal(stub->words[stub->word_count - 1], 0x001F); /* as long as it takes */
    assert_int_equal(stub->target, 4321);
    assert_false(epos2_enabled(&stub->engine));
    assert_false(epos2_homed(&stub->engine));
    stub->counts = 0;
    stub->bits = 0x9400;
    period(stub);
    period(stub);
    assert_int_equal(stub->mode, -1);
    assert_int_equal(stub->control, 0x000F);
    assert_int_equal(stub->target, 0); /* where it is, until it says that it is in the mode */
    stub->bits = 0x8000;
    periods(stub, 2);
    assert_true(epos2_enabled(&stub->engine));
    assert_int_equal(stub->target, 500);
    assert_int_equal(stub->engine.trouble.cause, EPOS2_FINE);
    stub->command.enable = false;
    periods(stub, 10);
    stub->command.enable = true;
    stub->word_count = 0;
    periods(stub, 10);
    assert_true(epos2_enabled(&stub->engine)); /* it knows its position, so it does not search again */
    assert_int_equal(stub->words[stub->word_count - 1], 0x000F);
    test_free(stub);
}

/* By what the drive says, or because it takes too long: the motor stays off until it is enabled anew. */
static void stops_when_it_finds_no_home(void **state)
{
    (void)state;
    for (int automatic = 0; automatic <= 1; automatic++)
        for (uint32_t code = 0; code <= 1; code++) {
            struct stub *stub = searching(automatic);
            stub->bits = code ? 0 : 0x2000;
            periods(stub, 10);
            assert_int_equal(stub->engine.trouble.cause, EPOS2_FINE); /* that may be of the search before */
            periods(stub, code ? 200 : 20);
            assert_int_equal(stub->engine.trouble.cause, EPOS2_NOT_HOMED);
            assert_int_equal(stub->engine.trouble.code, code);
            assert_int_equal(stub->status, 0x0040);
            periods(stub, 300);
            assert_int_equal(stub->control, 0);
            stub->command.enable = false;
            periods(stub, 2);
            stub->command.enable = true;
            periods(stub, 10);
            assert_int_equal(stub->control, 0x001F);
            stub->bits = 0x9400;
            periods(stub, 5);
            assert_true(epos2_enabled(&stub->engine));
            assert_int_equal(stub->engine.trouble.cause, EPOS2_FINE);
            test_free(stub);
        }
}

/* What is disabled, or gets no command, does not search on. */
static void searches_only_while_it_is_enabled(void **state)
{
    (void)state;
    struct stub *stub = searching(false);
    stub->command.target = NAN;
    periods(stub, 10);
    assert_int_equal(stub->status, 0x0040);
    stub->command.target = 5;
    stub->word_count = 0;
    periods(stub, 10);
    const uint16_t way[] = {0x0006, 0x0007, 0x000F, 0x001F};
    assert_memory_equal(stub->words, way, sizeof way);
    stub->command.enable = false;
    periods(stub, 10);
    assert_int_equal(stub->status, 0x0040);
    assert_int_equal(stub->engine.trouble.cause, EPOS2_FINE);
    test_free(stub);
}

static void finds_its_way_into_operation(void **state)
{
    (void)state;
    struct stub *stub = make(usual);
    stub->command = (struct epos2_command){.enable = true, .target = -3.2};
    period(stub);
    assert_int_equal(stub->sent_count, 3); /* our heartbeat, NMT reset communication, and SYNC for other drives */
    assert_int_equal(stub->sent[0].can_id, 0x77F);
    assert_int_equal(stub->sent[0].data[0], 5);
    assert_int_equal(stub->sent[1].can_id, 0);
    assert_memory_equal(stub->sent[1].data, "\x82\x05", 2);
    period(stub);
    assert_int_equal(stub->sent[0].can_id, 0x605); /* 6040 = 0: no power while it is configured */
    assert_memory_equal(stub->sent[0].data, "\x2B\x40\x60\x00\x00\x00\x00\x00", 8);
    period(stub);                                                                   /* our next heartbeat is due */
    assert_memory_equal(stub->sent[1].data, "\x2F\x60\x60\x00\xFE\x00\x00\x00", 8); /* 6060 = -2 */
    periods(stub, CONTACT);
    assert_true(epos2_enabled(&stub->engine));
    const uint16_t way[] = {0x0006, 0x0007, 0x000F};
    assert_int_equal(stub->word_count, 3);
    assert_memory_equal(stub->words, way, sizeof way);
    assert_int_equal(stub->target, -32); /* rpm */
    assert_int_equal(*object(stub, 0x140001), 0x205);
    assert_int_equal(*object(stub, 0x160001), 0x60400010);
    assert_int_equal(*object(stub, 0x140101), 0x80000305); /* not used, so off */
    assert_int_equal(*object(stub, 0x140201), 0x80000405);
    assert_int_equal(*object(stub, 0x180001), 0xC0000185);
    /* As shipped these are off, by bit 31. */
    assert_int_equal(*object(stub, 0x180101), 0x40000285);
    assert_int_equal(*object(stub, 0x180201), 0x40000385);
    assert_int_equal(*object(stub, 0x180301), 0x40000485);
    assert_int_equal(*object(stub, 0x160302), 0x206B0020);
    assert_int_equal(*object(stub, 0x101601), 127 << 16 | 100);
    test_free(stub);
}

/* A PDO is off while its mapping changes, and the number of mapped objects is 0 meanwhile. */
static void maps_in_the_standards_order(void **state)
{
    (void)state;
    struct stub *stub = enabled(usual);
    const uint32_t order[] = {0x180301, 0xC0000485, 0x180302, 1,          0x1A0300, 0, 0x1A0301, 0x60410010,
                              0x1A0302, 0x606C0020, 0x1A0303, 0x60780010, 0x1A0300, 3, 0x180301, 0x40000485};
    size_t at = 0;
    while (stub->objects[at] != order[0])
        at += 2;
    assert_memory_equal(&stub->objects[at], order, sizeof order);
    test_free(stub);
}

static void asks_for_nothing_unacknowledged(void **state)
{
    (void)state;
    struct stub *stub = make(usual);
    stub->command = (struct epos2_command){.enable = true, .target = 3};
    stub->moves_on = false;
    periods(stub, 100);
    assert_int_equal(stub->target, 0);
    assert_int_equal(stub->word_count, 1);
    assert_int_equal(stub->words[0], 0x0006);
    stub->status = 0x0021;
    periods(stub, 5);
    assert_int_equal(stub->words[stub->word_count - 1], 0x0007);
    stub->status = 0x0023;
    periods(stub, 5);
    assert_int_equal(stub->words[stub->word_count - 1], 0x000F);
    assert_false(epos2_enabled(&stub->engine));
    stub->status = 0x0227; /* with bits of other meaning */
    periods(stub, 2);
    assert_true(epos2_enabled(&stub->engine));
    stub->mode = 1; /* not the one asked for */
    periods(stub, 2);
    assert_false(epos2_enabled(&stub->engine));
    assert_int_equal(stub->control, 0x0006);
    test_free(stub);
}

static void measures_in_si(void **state)
{
    (void)state;
    struct stub *stub = enabled(usual);
    uint32_t before = stub->engine.sequence;
    stub->counts = -314;
    stub->rpm = -25;
    stub->ma = -1500;
    period(stub);
    assert_near(stub->engine.values.position, -3.14, 1e-12);
    assert_near(stub->engine.values.velocity, -2.5, 1e-12);
    assert_near(stub->engine.values.current, -1.5, 1e-12);
    assert_int_equal(stub->engine.sequence, before + 1);
    assert_true(stub->engine.values_ns == stub->now_ns);
    test_free(stub);
}

static void writes_targets_of_each_mode(void **state)
{
    (void)state;
    static const struct {
        enum epos2_mode mode;
        double target;
        int32_t written;
        uint8_t mode_6060, length;
    } cases[] = {
        {EPOS2_POSITION, 1.234, 123, 0xFF, 6},        {EPOS2_POSITION, 1e300, INT32_MAX, 0xFF, 6},
        {EPOS2_VELOCITY, 2.54, 25, 0xFE, 6},          {EPOS2_VELOCITY, -1e9, -500, 0xFE, 6},
        {EPOS2_CURRENT, -0.25, -250, 0xFD, 4},        {EPOS2_CURRENT, 40, 2000, 0xFD, 4},
        {EPOS2_PROFILE_POSITION, -0.5, -50, 0x01, 6}, {EPOS2_PROFILE_VELOCITY, 1.5, 15, 0x03, 6},
    };
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        struct epos2_settings settings = usual;
        settings.mode = cases[i].mode;
        settings.max_rpm = 500;
        settings.limit_ma = 2000;
        struct stub *stub = make(settings);
        stub->command = (struct epos2_command){.enable = true, .target = cases[i].target};
        periods(stub, CONTACT);
        assert_true(epos2_enabled(&stub->engine));
        assert_int_equal((uint8_t)stub->mode, cases[i].mode_6060);
        const struct can_frame *last = &stub->sent[stub->sent_count - 2];
        assert_int_equal(last->can_id, 0x505);
        assert_int_equal(last->len, cases[i].length);
        int32_t written = last->len == 4 ? (int16_t)(last->data[2] | last->data[3] << 8) : stub->target;
        assert_int_equal(written, cases[i].written);
        test_free(stub);
    }
}

static void configures_limits(void **state)
{
    (void)state;
    struct epos2_settings settings = usual;
    struct stub *stub = enabled(settings);
    assert_null(object(stub, 0x607F00)); /* what the drive has stored */
    assert_null(object(stub, 0x641002));
    test_free(stub);
    settings.max_rpm = 4000;
    settings.rpm_per_s = 9000;
    settings.stop_rpm_per_s = 20000;
    settings.limit_ma = 1500;
    stub = enabled(settings);
    assert_int_equal(*object(stub, 0x607F00), 4000);
    assert_int_equal(*object(stub, 0x608100), 4000);
    assert_int_equal(*object(stub, 0x608300), 9000);
    assert_int_equal(*object(stub, 0x608400), 9000);
    assert_int_equal(*object(stub, 0x608500), 20000);
    assert_int_equal(*object(stub, 0x641002), 1500);
    test_free(stub);
}

static void a_refused_object_is_told_and_tried_again(void **state)
{
    (void)state;
    struct stub *stub = make(usual);
    stub->command.enable = true;
    stub->refuse = 0x160302;
    periods(stub, 50);
    assert_int_equal(stub->engine.phase, EPOS2_REFUSED);
    assert_int_equal(stub->engine.abort_code, 0x06020000); /* the object does not exist */
    assert_int_equal(stub->engine.abort_write.index, 0x1603);
    assert_int_equal(stub->engine.abort_write.sub, 2);
    assert_false(stub->operational);
    assert_int_equal(stub->word_count, 0);
    stub->refuse = 0;
    periods(stub, 200);
    assert_true(epos2_enabled(&stub->engine));
    assert_int_equal(stub->engine.abort_code, 0);
    test_free(stub);
}

static void a_silent_sdo_server_is_reset(void **state)
{
    (void)state;
    struct stub *stub = make(usual);
    stub->command.enable = true;
    periods(stub, 10);
    stub->answers = false;
    periods(stub, 30);
    assert_int_equal(stub->engine.phase, EPOS2_CONFIGURING);
    int resets = 0;
    for (int i = 0; i < 40; i++) {
        period(stub);
        for (size_t f = 0; f < stub->sent_count; f++)
            resets += stub->sent[f].can_id == 0;
    }
    assert_int_equal(resets, 1);
    stub->answers = true;
    periods(stub, 120);
    assert_true(epos2_enabled(&stub->engine));
    test_free(stub);
}

static void faults(struct stub *stub)
{
    stub->status = 0x0008;
    deliver(stub, 0x080 + NODE, 8, "\x10\x23\x03\x00\x00\x00\x00\x00"); /* over-current */
    periods(stub, 10);
    assert_false(epos2_enabled(&stub->engine));
    assert_int_equal(stub->engine.error_code, 0x2310);
}

static void a_fault_waits_for_enable(void **state)
{
    (void)state;
    struct stub *stub = enabled(usual);
    faults(stub);
    periods(stub, 500);
    assert_int_equal(stub->status, 0x0008);
    assert_int_equal(stub->word_count, 2); /* 0x0F, then 0 */
    assert_int_equal(stub->words[1], 0x0000);
    stub->command.target = NAN; /* a command that is missing for a while is no new decision */
    periods(stub, 5);
    stub->command.target = 0;
    periods(stub, 5);
    assert_int_equal(stub->status, 0x0008);
    stub->command.enable = false;
    periods(stub, 5);
    assert_int_equal(stub->status, 0x0008);
    stub->command.enable = true;
    periods(stub, 10);
    const uint16_t way[] = {0x000F, 0x0000, 0x0080, 0x0006, 0x0007, 0x000F};
    assert_int_equal(stub->word_count, 6);
    assert_memory_equal(stub->words, way, sizeof way);
    assert_true(epos2_enabled(&stub->engine));
    assert_int_equal(stub->engine.error_code, 0);
    test_free(stub);
}

static void a_fault_that_stays_is_reset_once_a_second(void **state)
{
    (void)state;
    struct epos2_settings settings = usual;
    settings.automatic_reset = true;
    struct stub *stub = enabled(settings);
    stub->moves_on = false;
    faults(stub);
    int resets = 0;
    for (int i = 0; i < 500; i++) {
        period(stub);
        resets += stub->control == 0x0080;
        stub->word_count = 0;
    }
    assert_int_equal(resets, 5);
    test_free(stub);
}

static void stops_before_it_takes_the_power(void **state)
{
    (void)state;
    struct stub *stub = enabled(usual);
    stub->rpm = 400;
    stub->command.target = NAN; /* no command */
    periods(stub, 50);
    assert_int_equal(stub->status, 0x0007);
    assert_int_equal(stub->control, 0x0002);
    stub->rpm = 3;
    periods(stub, 3);
    assert_int_equal(stub->control, 0x0000);
    assert_int_equal(stub->status, 0x0040);
    stub->command.target = 1;
    periods(stub, 10);
    assert_true(epos2_enabled(&stub->engine));
    stub->rpm = 400; /* and one that does not come to rest loses its power after two seconds */
    stub->command.enable = false;
    periods(stub, 195);
    assert_int_equal(stub->control, 0x0002);
    periods(stub, 10);
    assert_int_equal(stub->control, 0x0000);
    test_free(stub);
}

/* A command that returns during a quick stop: by way of switch on disabled. */
static void resumes_from_a_quick_stop(void **state)
{
    (void)state;
    struct stub *stub = enabled(usual);
    stub->rpm = 400;
    stub->command.enable = false;
    periods(stub, 10);
    stub->command.enable = true;
    periods(stub, 10);
    const uint16_t way[] = {0x0002, 0x0000, 0x0006, 0x0007, 0x000F};
    assert_int_equal(stub->word_count, 5);
    assert_memory_equal(stub->words, way, sizeof way);
    test_free(stub);
}

static void a_lost_drive_is_begun_anew(void **state)
{
    (void)state;
    struct stub *stub = enabled(usual);
    stub->present = false;
    periods(stub, 9);
    assert_int_equal(stub->engine.phase, EPOS2_RUNNING);
    periods(stub, 4);
    assert_int_equal(stub->engine.phase, EPOS2_BOOTING);
    assert_false(epos2_enabled(&stub->engine));
    periods(stub, 300);
    stub->present = true;
    stub->status = 0x0040;
    stub->operational = false;
    periods(stub, 100 + CONTACT);
    assert_int_equal(stub->engine.phase, EPOS2_RUNNING);
    assert_true(stub->operational);
    test_free(stub);
}

/* --- how a drive that works stops to --- */

static void is_silent(struct stub *stub)
{
    stub->present = false;
    periods(stub, 300);
    stub->present = true;
    stub->status = 0x0040;
    stub->operational = false;
}

static void loses_its_power(struct stub *stub)
{
    deliver(stub, 0x700 + NODE, 1, "\x00");
    assert_int_equal(stub->engine.phase, EPOS2_CONFIGURING);
    stub->operational = false;
    stub->status = 0x0040;
}

static void is_stopped_by_another_master(struct stub *stub)
{
    stub->operational = false;
    stub->status = 0x0040;
}

static void leaves_operation(struct stub *stub)
{
    stub->status = 0x0040;
}

static void is_cut_off(struct stub *stub)
{
    epos2_lose(&stub->engine);
}

static void has_a_fault(struct stub *stub)
{
    stub->status = 0x0008;
    deliver(stub, 0x080 + NODE, 8, "\x30\x81\x11\x00\x00\x00\x00\x00"); /* it missed our heartbeats */
}

static void (*const failures[])(struct stub *stub) = {
    is_silent, loses_its_power, is_stopped_by_another_master, leaves_operation, is_cut_off, has_a_fault,
};
enum { FAILURES = sizeof failures / sizeof failures[0], LONG = 400 };

static void a_motor_that_stopped_waits_for_enable(void **state)
{
    (void)state;
    struct epos2_settings settings = usual;
    settings.automatic_reset = true; /* which takes the fault away, and no more */
    for (size_t i = 0; i < FAILURES; i++) {
        struct stub *stub = enabled(settings);
        failures[i](stub);
        periods(stub, 5); /* it becomes known */
        stub->word_count = 0;
        periods(stub, LONG);
        assert_true(stub->operational);
        assert_int_equal(stub->engine.phase, EPOS2_RUNNING);
        assert_int_equal(stub->status, 0x0040);
        for (size_t word = 0; word < stub->word_count; word++)
            assert_false(stub->words[word] & 0x0005); /* nothing on the way up, which begins with shutdown, 6 */
        stub->command.target = NAN;                   /* a command that is missing for a while is no new decision */
        periods(stub, 5);
        stub->command.target = 0;
        periods(stub, 5);
        assert_int_equal(stub->status, 0x0040);
        stub->command.enable = false;
        periods(stub, 5);
        assert_int_equal(stub->status, 0x0040);
        stub->command.enable = true;
        periods(stub, 10);
        assert_true(epos2_enabled(&stub->engine));
        test_free(stub);
    }
}

static void a_motor_that_stopped_restarts_where_that_is_wanted(void **state)
{
    (void)state;
    struct epos2_settings settings = usual;
    settings.automatic_reset = settings.automatic_restart = true;
    for (size_t i = 0; i < FAILURES; i++) {
        struct stub *stub = enabled(settings);
        failures[i](stub);
        periods(stub, LONG);
        assert_true(epos2_enabled(&stub->engine));
        test_free(stub);
    }
}

/* Nobody who switches it on while its power is off expects it to start with the power. */
static void enable_is_for_a_drive_that_is_there(void **state)
{
    (void)state;
    struct stub *stub = make(usual);
    stub->present = false;
    stub->command.enable = true;
    periods(stub, 300);
    stub->present = true;
    periods(stub, LONG);
    assert_true(epos2_enabled(&stub->engine)); /* the first time it may be later than the task */
    stub->present = false;
    periods(stub, 300);
    stub->command.enable = false;
    periods(stub, 5);
    stub->command.enable = true;
    periods(stub, 5);
    stub->present = true;
    stub->operational = false;
    stub->status = 0x0040;
    periods(stub, LONG);
    assert_int_equal(stub->engine.phase, EPOS2_RUNNING);
    assert_int_equal(stub->status, 0x0040);
    test_free(stub);
}

static void names_the_first_cause(void **state)
{
    (void)state;
    struct epos2_settings settings = usual;
    settings.automatic_restart = true;
    struct stub *stub = make(settings);
    const struct epos2_trouble *trouble = &stub->engine.trouble;
    stub->command.enable = true;
    stub->present = false;
    periods(stub, 50);
    assert_int_equal(trouble->cause, EPOS2_FINE); /* it has another half a second */
    periods(stub, 100);
    assert_int_equal(trouble->cause, EPOS2_NO_ANSWER);
    stub->present = true;
    periods(stub, LONG);
    assert_int_equal(trouble->cause, EPOS2_FINE);
    stub->present = false;
    periods(stub, 500);
    assert_int_equal(trouble->cause, EPOS2_NO_HEARTBEAT);
    stub->present = true;
    stub->refuse = 0x160302;
    periods(stub, LONG);
    assert_int_equal(trouble->cause, EPOS2_ABORTED);
    assert_int_equal(trouble->index, 0x1603);
    assert_int_equal(trouble->sub, 2);
    assert_int_equal(trouble->code, 0x06020000);
    stub->refuse = 0;
    periods(stub, LONG);
    assert_int_equal(trouble->cause, EPOS2_FINE);
    faults(stub);
    assert_int_equal(trouble->cause, EPOS2_EMERGENCY);
    assert_int_equal(trouble->code, 0x2310);
    stub->command.enable = false;
    periods(stub, 5);
    stub->command.enable = true;
    periods(stub, 5);
    assert_int_equal(trouble->cause, EPOS2_FINE);
    test_free(stub);
}

/* Of three heartbeats in a row two are lost, on either way, and no side takes the other for lost, though it does so
 * after `heartbeat`. Seen to fail: none came for 60 ms of 40, and with those of the drive twice in `heartbeat` it was
 * given up. */
static void two_heartbeats_may_be_lost(void **state)
{
    (void)state;
    for (uint16_t heartbeat_ms = 4 * PERIOD_MS; heartbeat_ms <= 1000; heartbeat_ms += 7) {
        struct epos2_settings settings = usual;
        settings.heartbeat_ms = heartbeat_ms;
        struct stub *stub = enabled(settings);
        assert_int_equal(*object(stub, 0x101601), 127 << 16 | heartbeat_ms);
        stub->lossy_ns = 3 * *object(stub, 0x101700) * MS;
        int64_t last_ns = stub->now_ns, longest_ns = 0;
        int count = 0, steps = 20 * heartbeat_ms / PERIOD_MS;
        for (int i = 0; i < steps; i++) {
            period(stub);
            for (size_t f = 0; f < stub->sent_count; f++) {
                if (stub->sent[f].can_id != 0x77F || count++ % 3)
                    continue;
                longest_ns = stub->now_ns - last_ns > longest_ns ? stub->now_ns - last_ns : longest_ns;
                last_ns = stub->now_ns;
            }
        }
        assert_true(longest_ns > 0 && longest_ns + PERIOD_MS * MS <= heartbeat_ms * MS); /* and a step may be late */
        assert_in_range(count, 20 * 4, 20 * 8);
        assert_true(epos2_enabled(&stub->engine));
        assert_int_equal(stub->engine.trouble.cause, EPOS2_FINE);
        stub->present = false;
        periods(stub, heartbeat_ms / PERIOD_MS + 2);
        assert_int_equal(stub->engine.trouble.cause, EPOS2_NO_HEARTBEAT);
        test_free(stub);
    }
}

/* A drive that has not received any would not miss them: the motor would run on for ever. */
static void a_heartbeat_comes_before_any_motion(void **state)
{
    (void)state;
    struct epos2_settings settings = usual;
    settings.heartbeat_ms = 10000;
    struct stub *stub = make(settings);
    stub->command.enable = true;
    bool received = false;
    while (!stub->operational) {
        bool watches = object(stub, 0x101601);
        period(stub);
        for (size_t i = 0; i < stub->sent_count && !stub->engine.sdo_waiting; i++) {
            received = received || (watches && stub->sent[i].can_id == 0x77F);
            assert_true(stub->sent[i].can_id != 0 || stub->sent[i].data[0] != 1 || received); /* NMT start */
        }
    }
    assert_true(received);
    test_free(stub);
}

static void offers_positions_by_edges(void **state)
{
    (void)state;
    struct epos2_settings settings = usual;
    settings.mode = EPOS2_PROFILE_POSITION;
    struct stub *stub = enabled(settings);
    periods(stub, 5);
    stub->status = 0x1027; /* it acknowledges the first, where it stood */
    periods(stub, 3);
    stub->status = 0x0027;
    periods(stub, 3);
    stub->word_count = 0;
    stub->command.target = 2;
    periods(stub, 3);
    assert_int_equal(stub->control, 0x003F);
    assert_int_equal(stub->target, 200);
    stub->status = 0x1027;
    stub->command.target = 3; /* not while the last is being acknowledged */
    periods(stub, 3);
    assert_int_equal(stub->control, 0x000F);
    assert_int_equal(stub->target, 200);
    stub->status = 0x0027;
    periods(stub, 3);
    assert_int_equal(stub->control, 0x003F);
    assert_int_equal(stub->target, 300);
    stub->status = 0x1027;
    periods(stub, 3);
    stub->status = 0x0027;
    periods(stub, 20); /* nothing new: nothing is offered */
    const uint16_t way[] = {0x000F, 0x003F, 0x000F, 0x003F, 0x000F};
    assert_memory_equal(stub->words, way + (stub->words[0] == 0x003F), 4 * sizeof *way);
    assert_int_equal(stub->control, 0x000F);
    test_free(stub);
}

static void stops_by_every_way_and_then_disables(void **state)
{
    (void)state;
    struct can_frame out[EPOS2_FRAMES];
    struct stub *stub = enabled(usual);
    assert_int_equal(epos2_quick_stop(&stub->engine, out), 3);
    assert_int_equal(out[0].can_id, 0x505); /* the PDO of the commands */
    assert_int_equal(out[0].len, 6);
    assert_memory_equal(out[0].data, "\2\0", 2);
    assert_int_equal(out[1].can_id, 0x205);
    assert_int_equal(out[1].len, 2);
    assert_memory_equal(out[1].data, "\2\0", 2);
    assert_int_equal(out[2].can_id, 0x605); /* an SDO */
    assert_memory_equal(out[2].data, "\x2B\x40\x60\0\2\0\0\0", 8);
    assert_true(epos2_powered(&stub->engine));
    stub->command.enable = false;
    periods(stub, 10);
    assert_false(epos2_powered(&stub->engine));
    assert_int_equal(epos2_shutdown(&stub->engine, out), 4);
    assert_int_equal(out[0].can_id, 0x505);
    assert_memory_equal(out[0].data, "\0\0", 2);
    assert_memory_equal(out[1].data, "\0\0", 2);
    assert_memory_equal(out[2].data, "\x2B\x40\x60\0\0\0\0\0", 8);
    assert_int_equal(out[3].can_id, 0);
    assert_memory_equal(out[3].data, "\x82\x05", 2);
    test_free(stub);
}

static void ignores_what_is_not_the_drives(void **state)
{
    (void)state;
    struct stub *stub = enabled(usual);
    uint32_t sequence = stub->engine.sequence;
    deliver(stub, 0x386, 6, "\x27\0\1\1\1\1");                /* another node */
    deliver(stub, 0x385 | CAN_EFF_FLAG, 6, "\x27\0\1\1\1\1"); /* another format */
    deliver(stub, 0x385 | CAN_RTR_FLAG, 6, "\x27\0\1\1\1\1"); /* a request */
    deliver(stub, 0x385, 5, "\x27\0\1\1\1");                  /* another length */
    deliver(stub, 0x485, 7, "\x27\0\1\1\1\1\1");
    assert_int_equal(stub->engine.sequence, sequence);
    assert_int_equal(stub->engine.counts, 0);
    deliver(stub, 0x485, 8, "\x27\0\1\1\1\1\1\1"); /* a velocity without its position is no set */
    assert_int_equal(stub->engine.sequence, sequence);
    stub->engine.phase = EPOS2_CONFIGURING;
    stub->engine.sdo_waiting = true;
    stub->engine.write_next = 1;
    deliver(stub, 0x585, 8, "\x60\x40\x60\0\0\0\0\0"); /* the answer to another request */
    assert_int_equal(stub->engine.write_next, 1);
    deliver(stub, 0x585, 8, "\x60\x60\x60\0\0\0\0\0");
    assert_int_equal(stub->engine.write_next, 2);
    test_free(stub);
}

/* Whatever arrives, the motor is switched on only from the state that allows it, and never without a command. */
static void survives_any_frames(void **state)
{
    (void)state;
    static const uint16_t bases[] = {0x080, 0x180, 0x280, 0x380, 0x480, 0x580, 0x700};
    static const uint8_t lengths[] = {8, 2, 3, 6, 8, 8, 1};
    struct epos2 engine;
    struct epos2_settings settings = usual;
    settings.mode = EPOS2_PROFILE_POSITION;
    settings.automatic_reset = settings.automatic_restart = true;
    epos2_begin(&engine, &settings);
    srand(20);
    size_t operated = 0;
    for (int64_t now_ns = 0; now_ns < 1000 * 1000 * MS; now_ns += MS) {
        struct can_frame frame, out[EPOS2_FRAMES];
        int which = rand() % 7;
        for (size_t i = 0; i < 8; i++)
            frame.data[i] = (uint8_t)rand();
        if (rand() % 4) { /* mostly plausible, or it would never come far */
            const struct epos2_write *write = &engine.writes[engine.write_next];
            frame.data[0] = (uint8_t)(which == 5 ? 0x60 : which == 6 ? 0x05 : "\x40\x21\x23\x27"[rand() % 4]);
            if (which == 5)
                memcpy(frame.data + 1, (uint8_t[]){(uint8_t)write->index, (uint8_t)(write->index >> 8), write->sub}, 3);
            else if (which < 5)
                memcpy(frame.data + 1, (uint8_t[]){0, 1}, 2);
        }
        frame.can_id = (canid_t)(rand() % 64 ? bases[which] + NODE : rand());
        frame.len = (uint8_t)(rand() % 64 ? lengths[which] : rand() % 9);
        epos2_receive(&engine, &frame, now_ns);
        const struct epos2_command command = {rand() % 8, rand() % 2, rand() % 8 ? (double)rand() : (double)NAN};
        size_t count = epos2_advance(&engine, now_ns, &command, out);
        assert_true(count <= EPOS2_FRAMES);
        for (size_t i = 0; i < count; i++) {
            if (out[i].can_id != 0x505 || (out[i].data[0] & 0x0F) != 0x0F)
                continue;
            operated++;
            assert_true(command.enable && isfinite(command.target));
            assert_true((engine.status_word & 0x6F) == 0x23 || (engine.status_word & 0x6F) == 0x27);
            assert_int_equal(engine.mode_display, 1);
        }
    }
    assert_true(operated > 1000);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(searches_its_home_first),
        cmocka_unit_test(stops_when_it_finds_no_home),
        cmocka_unit_test(searches_only_while_it_is_enabled),
        cmocka_unit_test(finds_its_way_into_operation),
        cmocka_unit_test(maps_in_the_standards_order),
        cmocka_unit_test(asks_for_nothing_unacknowledged),
        cmocka_unit_test(measures_in_si),
        cmocka_unit_test(writes_targets_of_each_mode),
        cmocka_unit_test(configures_limits),
        cmocka_unit_test(a_refused_object_is_told_and_tried_again),
        cmocka_unit_test(a_silent_sdo_server_is_reset),
        cmocka_unit_test(a_fault_waits_for_enable),
        cmocka_unit_test(a_fault_that_stays_is_reset_once_a_second),
        cmocka_unit_test(stops_before_it_takes_the_power),
        cmocka_unit_test(resumes_from_a_quick_stop),
        cmocka_unit_test(a_lost_drive_is_begun_anew),
        cmocka_unit_test(a_motor_that_stopped_waits_for_enable),
        cmocka_unit_test(a_motor_that_stopped_restarts_where_that_is_wanted),
        cmocka_unit_test(enable_is_for_a_drive_that_is_there),
        cmocka_unit_test(names_the_first_cause),
        cmocka_unit_test(two_heartbeats_may_be_lost),
        cmocka_unit_test(a_heartbeat_comes_before_any_motion),
        cmocka_unit_test(offers_positions_by_edges),
        cmocka_unit_test(stops_by_every_way_and_then_disables),
        cmocka_unit_test(ignores_what_is_not_the_drives),
        cmocka_unit_test(survives_any_frames),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
