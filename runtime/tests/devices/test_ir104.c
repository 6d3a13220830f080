#define _GNU_SOURCE
#include "said.h"

#include "blocks/devices/ports.h"
#include "core/service.h"

#include <errno.h>
#include <linux/capability.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

/* --- a board in a port space of its own --- */

static struct {
    uint16_t base;
    bool permitted;
    int refusal; /* errno of permit */
    uint8_t relays[3];
    uint8_t inputs[3];
    uint8_t stuck[3]; /* bits of relays that always read 0 */
    unsigned writes;
} board;

static int permit(uint16_t first, uint16_t count, bool on)
{
    assert_int_equal(first, board.base);
    assert_int_equal(count, 8);
    if (!board.refusal)
        board.permitted = on;
    return board.refusal;
}

/* Without permission the processor would raise SIGSEGV. */
static unsigned reached(uint16_t port)
{
    assert_true(board.permitted);
    assert_in_range(port, board.base, board.base + 7);
    return port - board.base;
}

static uint8_t in(uint16_t port)
{
    unsigned at = reached(port);
    if (at < 3)
        return board.relays[at] & (uint8_t)~board.stuck[at];
    assert_in_range(at, 4, 6);
    return board.inputs[at - 4];
}

static void out(uint16_t port, uint8_t value)
{
    unsigned at = reached(port);
    assert_in_range(at, 0, 2);
    board.relays[at] = value;
    board.writes++;
}

static const struct port_space fake = {permit, in, out};
static const struct port_space *real;

static int plug_in(void **state)
{
    (void)state;
    memset(&board, 0, sizeof board);
    board.base = 0x300;
    port_space = &fake;
    return 0;
}

static uint32_t relays(void)
{
    return board.relays[0] | (uint32_t)board.relays[1] << 8 | (uint32_t)board.relays[2] << 16;
}

#define RELAY(number) (UINT32_C(1) << ((number) - 1))

static void command(struct fl_block *block, bool flag, const bool *values, size_t count)
{
    memcpy(testbed_input(block, "command"), values, count);
    SET(block, "flag", bool, flag);
    assert_int_equal(testbed_step(block), FL_OK);
}

/* --- tests --- */

static void drives_channels_in_order(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("ir104-pbf", "channels", "20,1,9,8", NULL);
    testbed_begin(block);
    command(block, true, (bool[]){1, 0, 0, 0}, 4);
    assert_int_equal(relays(), RELAY(20));
    command(block, true, (bool[]){0, 1, 1, 0}, 4);
    assert_int_equal(relays(), RELAY(1) | RELAY(9));
    assert_memory_equal(testbed_output(block, "relays"), ((bool[]){0, 1, 1, 0}), 4);
    command(block, true, (bool[]){1, 1, 1, 1}, 4);
    assert_int_equal(relays(), RELAY(20) | RELAY(1) | RELAY(9) | RELAY(8));
    assert_false(GET(block, "mismatch", bool));
    assert_false(GET(block, "timed_out", bool));
    testbed_end(block);
    assert_int_equal(relays(), 0);
    assert_false(board.permitted);
}

static void has_vectors(void **state)
{
    (void)state;
    struct fl_block *block =
        testbed_block("ir104-pbf", "channels", "3,4,5", "initial", "1,0,0", "reset", "0,1,1", NULL);
    testbed_begin(block);
    assert_int_equal(relays(), RELAY(3));
    command(block, true, (bool[]){1, 1, 1}, 3);
    assert_int_equal(relays(), RELAY(3) | RELAY(4) | RELAY(5));
    block->type->safe(block);
    assert_int_equal(relays(), RELAY(4) | RELAY(5));
    command(block, true, (bool[]){1, 0, 0}, 3);
    assert_int_equal(relays(), RELAY(3));
    testbed_end(block);
    assert_int_equal(relays(), RELAY(4) | RELAY(5));
    block = testbed_block("ir104-pbf", "channels", "1,2", "initial", "1", NULL); /* one for all */
    testbed_begin(block);
    assert_int_equal(relays(), RELAY(1) | RELAY(2));
    testbed_end(block);
}

static void bases_are_as_jumpered(void **state)
{
    (void)state;
    static const struct {
        const char *text;
        uint16_t base;
    } bases[] = {{"0x240", 0x240}, {"0x260", 0x260}, {"0x280", 0x280}, {"0x300", 0x300}};
    for (size_t i = 0; i < 4; i++) {
        board.base = bases[i].base;
        struct fl_block *block = testbed_block("ir104-pbf", "channels", "1,2", "base", bases[i].text, NULL);
        testbed_begin(block);
        command(block, true, (bool[]){0, 1}, 2);
        assert_int_equal(relays(), RELAY(2));
        testbed_end(block);
    }
}

/* Steps at `release_ns`, without a new command. */
static uint32_t relays_at(struct fl_block *block, int64_t release_ns)
{
    block->release_ns = release_ns - block->period_ns;
    assert_int_equal(testbed_step(block), FL_OK);
    return relays();
}

static void times_out(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("ir104-pbf", "channels", "1,2", "reset", "0,1", "timeout", "0.5", NULL);
    testbed_begin(block);
    command(block, true, (bool[]){1, 0}, 2);
    int64_t commanded = block->release_ns;
    /* A bad command is not carried out; the last good one holds until the time-out, and exactly so long. */
    command(block, false, (bool[]){1, 1}, 2);
    assert_int_equal(relays(), RELAY(1));
    assert_int_equal(relays_at(block, commanded + 500000000), RELAY(1));
    assert_false(GET(block, "timed_out", bool));
    assert_int_equal(relays_at(block, commanded + 500000001), RELAY(2));
    assert_true(GET(block, "timed_out", bool));
    assert_memory_equal(testbed_output(block, "relays"), ((bool[]){0, 1}), 2);
    assert_int_equal(relays_at(block, commanded + 900000000), RELAY(2));
    command(block, true, (bool[]){1, 0}, 2);
    assert_int_equal(relays(), RELAY(1));
    assert_false(GET(block, "timed_out", bool));
    testbed_end(block);
}

static void times_out_without_any_command(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("ir104-pbf", "channels", "1,2", "initial", "1,1", "timeout", "0.5", NULL);
    testbed_begin(block);
    testbed_step(block);
    int64_t first = block->release_ns;
    assert_int_equal(relays(), RELAY(1) | RELAY(2));
    assert_int_equal(relays_at(block, first + 500000000), RELAY(1) | RELAY(2));
    assert_int_equal(relays_at(block, first + 500000001), 0);
    testbed_end(block);
}

static void times_out_by_sequence(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("ir104-pbf", "channels", "1,2", "fresh", "sequence", "timeout", "0.5", NULL);
    testbed_begin(block);
    SET(block, "command", bool, true);
    testbed_step(block); /* no sequence yet: no command */
    assert_int_equal(relays(), 0);
    SET(block, "sequence", uint32_t, 1);
    testbed_step(block);
    int64_t commanded = block->release_ns;
    assert_int_equal(relays(), RELAY(1));
    assert_int_equal(relays_at(block, commanded + 500000000), RELAY(1));
    assert_int_equal(relays_at(block, commanded + 500000001), 0);
    SET(block, "sequence", uint32_t, UINT32_MAX);
    assert_int_equal(relays_at(block, commanded + 600000000), RELAY(1));
    SET(block, "sequence", uint32_t, 0); /* wraps */
    assert_int_equal(relays_at(block, commanded + 1100000000), RELAY(1));
    assert_int_equal(relays_at(block, commanded + 1600000000), RELAY(1));
    assert_int_equal(relays_at(block, commanded + 1600000001), 0);
    testbed_end(block);
}

static void reads_inputs(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("ir104-pbf", NULL);
    const bool *inputs = testbed_output(block, "inputs");
    testbed_begin(block);
    for (unsigned number = 1; number <= 20; number++) {
        memset(board.inputs, 0xff, sizeof board.inputs); /* none is driven */
        board.inputs[(number - 1) / 8] &= (uint8_t)~(1u << (number - 1) % 8);
        testbed_step(block);
        for (unsigned i = 1; i <= 20; i++)
            assert_int_equal(inputs[i - 1], i == number);
    }
    assert_int_equal(relays(), 0);
    assert_false(GET(block, "timed_out", bool)); /* without channels there is nothing to command */
    testbed_end(block);
}

static void tells_a_mismatch(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("ir104-pbf", "channels", "9,10", NULL);
    struct said said = said_begin();
    testbed_begin(block);
    board.stuck[1] = 1 << 1; /* relay 10 */
    command(block, true, (bool[]){1, 0}, 2);
    assert_false(GET(block, "mismatch", bool));
    command(block, true, (bool[]){1, 1}, 2);
    assert_true(GET(block, "mismatch", bool));
    assert_memory_equal(testbed_output(block, "relays"), ((bool[]){1, 0}), 2);
    board.stuck[1] = 0;
    command(block, true, (bool[]){1, 1}, 2);
    assert_false(GET(block, "mismatch", bool));
    board.relays[2] = 0xf0; /* bits without a relay are no matter; each step writes them anew anyway */
    command(block, true, (bool[]){1, 1}, 2);
    assert_false(GET(block, "mismatch", bool));
    testbed_end(block);
    assert_int_equal(said_times(&said, "relays do not read back as they were written"), 1);
    said_end(&said);
}

/* flotilla-run --safe: nothing but start, safe, terminate, whatever the board was left in. */
static void is_safe_right_after_start(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("ir104-pbf", "channels", "1,2", "initial", "1", "reset", "0,1", NULL);
    memset(board.relays, 0xff, sizeof board.relays);
    assert_int_equal(block->type->start(block), FL_OK);
    assert_int_equal(relays(), 0xffffff); /* start alone writes nothing */
    block->type->safe(block);
    assert_int_equal(relays(), RELAY(2));
    testbed_end(block);
    assert_int_equal(relays(), RELAY(2));
    assert_false(board.permitted);
}

/* After a start of the service they stay in `reset`, also before the first command, until a command was equal to it. */
static void waits_for_a_command_that_is_off(void **state)
{
    (void)state;
    static const struct {
        bool first, second, flag;
        uint32_t relays;
    } steps[] = {{1, 0, 1, RELAY(2)}, {0, 1, 0, RELAY(2)}, {1, 1, 1, RELAY(2)},
                 {0, 1, 1, RELAY(2)}, {1, 0, 1, RELAY(1)}, {1, 1, 1, RELAY(1) | RELAY(2)}};
    struct fl_block *block = testbed_block("ir104-pbf", "channels", "1,2", "initial", "1,0", "reset", "0,1", NULL);
    bool *command = testbed_input(block, "command");
    block->service->wait = FL_WAIT_BEGUN;
    testbed_begin(block);
    assert_int_equal(relays(), RELAY(2));
    for (size_t i = 0; i < sizeof steps / sizeof steps[0]; i++) {
        command[0] = steps[i].first;
        command[1] = steps[i].second;
        SET(block, "flag", bool, steps[i].flag);
        assert_int_equal(testbed_step(block), FL_OK);
        assert_int_equal(relays(), steps[i].relays);
        assert_int_equal(block->service->wait, i < 3 ? FL_WAITS : FL_WAIT_NOT);
    }
    testbed_end(block);
}

/* Relay 2 is stuck, relay 9 too but not driven; then the ports are not to be had any more. */
static void says_what_could_not_be_reset(void **state)
{
    (void)state;
    static const struct {
        uint8_t stuck[3];
        int refusal;
        const char *reason;
    } cases[] = {{.stuck = {0, 1}},
                 {.stuck = {2}, .reason = "relays do not read back as they were written"},
                 {.refusal = EPERM, .reason = "it may not use the board's ports"}};
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        struct fl_block *block = testbed_block("ir104-pbf", "channels", "1,2", "reset", "0,1", NULL);
        testbed_begin(block);
        memcpy(board.stuck, cases[i].stuck, sizeof board.stuck);
        board.refusal = cases[i].refusal;
        block->type->safe(block);
        const char *reason = block->service->not_safe;
        if (cases[i].reason)
            assert_string_equal(reason, cases[i].reason);
        else
            assert_null(reason);
        board.refusal = 0;
        memset(board.stuck, 0, sizeof board.stuck);
        testbed_end(block);
    }
}

/* Without permission no port may be touched: `reached` checks. */
static void touches_nothing_without_permission(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("ir104-pbf", "channels", "1", NULL);
    board.refusal = EPERM;
    assert_int_equal(block->type->start(block), FL_FAILED);
    assert_non_null(strstr(block->service->failure, "I/O ports 0x300 to 0x307 need the privilege CAP_SYS_RAWIO"));
    assert_non_null(strstr(block->service->failure, "AmbientCapabilities=CAP_SYS_RAWIO"));
    block->type->safe(block);
    testbed_end(block);
    block = testbed_block("ir104-pbf", "channels", "1", NULL);
    board.refusal = ENOSYS;
    assert_int_equal(block->type->start(block), FL_FAILED);
    assert_non_null(strstr(block->service->failure, "I/O ports 0x300 to 0x307: Function not implemented"));
    testbed_end(block);
    assert_int_equal(board.writes, 0);
}

/* The kernel's own refusal, with the processor's real ports; some kernels have no ioperm(). */
enum { NO_PORTS = 77 };

static void names_the_missing_privilege(void **state)
{
    (void)state;
    struct fl_block *block = testbed_block("ir104-pbf", "channels", "1", NULL);
    int status;
    port_space = real;
    pid_t child = fork();
    if (child == 0) {
        struct __user_cap_header_struct header = {.version = _LINUX_CAPABILITY_VERSION_3};
        struct __user_cap_data_struct none[2] = {0};
        if (syscall(SYS_capset, &header, none) < 0)
            _exit(1);
        if (block->type->start(block) != FL_FAILED)
            _exit(2);
        if (strstr(block->service->failure, strerror(ENOSYS)))
            _exit(NO_PORTS);
        _exit(strstr(block->service->failure, "CAP_SYS_RAWIO") ? 0 : 3);
    }
    assert_int_equal(waitpid(child, &status, 0), child);
    port_space = &fake;
    testbed_end(block);
    if (WEXITSTATUS(status) == NO_PORTS)
        skip();
    assert_int_equal(status, 0);
}

static void refuses(void **state)
{
    (void)state;
    static const struct {
        const char *channels, *name, *value, *reason;
    } bad[] = {
        {"0", "base", "0x300", "parameter channels: 0 is outside 1 to 20"},
        {"1,21,22", "base", "0x300", "parameter channels: 21 is outside 1 to 20"},
        {"1.5", "base", "0x300", "parameter channels: 1.5 is not a relay's number"},
        {"1,2,1", "base", "0x300", "parameter channels: relay 1 is given twice"},
        {"1,2", "base", "0x200", "0x200 is not one of 0x240|0x260|0x280|0x300"},
        {"1,2,3", "initial", "1,0", "parameter initial: 2 values for 3 channels; give as many, or one for all"},
        {"1,2", "reset", "1,0,1", "parameter reset: 3 values for 2 channels"},
        {"1,2", "reset", "2", "parameter reset: 2 is outside 0 to 1"},
        {"1,2", "reset", "0.5,0", "parameter reset: 0.5 is neither 0 nor 1"},
        {"1,2", "timeout", "0", "parameter timeout: 0 is outside 0.001 to 60 s"},
        {"1,2", "fresh", "never", "never is not one of flag|sequence"},
    };
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
        const char *said = testbed_refusal("ir104-pbf", "channels", bad[i].channels, bad[i].name, bad[i].value, NULL);
        if (!strstr(said, bad[i].reason))
            fail_msg("%s: %s", bad[i].reason, said);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup(drives_channels_in_order, plug_in),
        cmocka_unit_test_setup(has_vectors, plug_in),
        cmocka_unit_test_setup(bases_are_as_jumpered, plug_in),
        cmocka_unit_test_setup(times_out, plug_in),
        cmocka_unit_test_setup(times_out_without_any_command, plug_in),
        cmocka_unit_test_setup(times_out_by_sequence, plug_in),
        cmocka_unit_test_setup(reads_inputs, plug_in),
        cmocka_unit_test_setup(tells_a_mismatch, plug_in),
        cmocka_unit_test_setup(is_safe_right_after_start, plug_in),
        cmocka_unit_test_setup(says_what_could_not_be_reset, plug_in),
        cmocka_unit_test_setup(waits_for_a_command_that_is_off, plug_in),
        cmocka_unit_test_setup(touches_nothing_without_permission, plug_in),
        cmocka_unit_test_setup(names_the_missing_privilege, plug_in),
        cmocka_unit_test_setup(refuses, plug_in),
    };
    real = port_space;
    return cmocka_run_group_tests(tests, NULL, NULL);
}
