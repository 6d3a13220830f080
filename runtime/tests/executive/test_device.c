#define _GNU_SOURCE
#include "executive/block.h"
#include "executive/device.h"
#include "testbed.h"

#include <poll.h>
#include <sys/wait.h>
#include <unistd.h>

enum { PATIENCE_MS = 60 * 1000 };

struct board {
    int base;
};

static const struct fl_parameter parameters[] = {
    FL_PARAMETER(struct board, base, .flags = FL_EXCLUSIVE, .choices = "0x300|0x240"),
};

static void safe(struct fl_block *block)
{
    (void)block;
}

/* No two runs of this test at a time meet: the name has the process. */
static char name[32];

static struct fl_block *board(struct fl_block_type *type, int base)
{
    *type = (struct fl_block_type){
        .abi = FL_ABI, .name = name, FL_TABLE(parameter, parameters), .parameters_size = sizeof(struct board)};
    type->safe = safe;
    struct fl_block *block = block_create(type, "relays");
    ((struct board *)(uintptr_t)block->parameters)->base = base;
    return block;
}

/* A process that has the board until somebody waits for it, or this process says so; its end of a pipe. */
static pid_t holder(uid_t user, bool until_awaited, int *end)
{
    int ready[2], ended[2];
    char byte;
    assert_int_equal(pipe(ready), 0);
    assert_int_equal(pipe(ended), 0);
    pid_t process = fork();
    if (!process) {
        struct fl_block_type type;
        struct fl_block *block = board(&type, 0);
        close(ended[1]);
        if ((user != geteuid() && setresuid(user, user, user) != 0) || device_claim(block) != FL_OK ||
            write(ready[1], "", 1) != 1)
            _exit(1);
        struct pollfd waiting = {.fd = until_awaited ? block->service->claim_fd : ended[0], .events = POLLIN};
        poll(&waiting, 1, PATIENCE_MS);
        _exit(0);
    }
    close(ready[1]);
    close(ended[0]);
    assert_int_equal(read(ready[0], &byte, 1), 1);
    close(ready[0]);
    *end = ended[1];
    return process;
}

static void a_device_is_held_by_one_process(void **state)
{
    (void)state;
    char said[64];
    struct fl_block_type type, second;
    struct fl_block *block = board(&type, 0), *other = board(&second, 1);
    int end;
    pid_t process = holder(geteuid(), false, &end);
    snprintf(said, sizeof said, "base 0x300 is held by process %d (", (int)process);
    assert_int_equal(device_claim(block), FL_FAILED);
    assert_non_null(strstr(block->service->failure, said));
    assert_int_equal(device_claim(other), FL_OK);
    close(end);
    waitpid(process, NULL, 0);
    assert_int_equal(device_claim(block), FL_OK);
    block_destroy(block);
    block_destroy(other);
}

static void who_waits_gets_it_from_a_process_that_ends(void **state)
{
    (void)state;
    struct fl_block_type type;
    struct fl_block *block = board(&type, 0);
    int end;
    pid_t process = holder(geteuid(), true, &end);
    block->service->patience_ms = PATIENCE_MS;
    assert_int_equal(device_claim(block), FL_OK);
    waitpid(process, NULL, 0);
    close(end);
    block_destroy(block);
}

/* As a service's user, which root alone can become. Seen to fail: `base 0x300 is held by process …` after a second, so
 * relays stayed on. */
static void no_app_keeps_a_service_from_making_outputs_safe(void **state)
{
    (void)state;
    struct fl_block_type type;
    int end;
    if (geteuid() != 0)
        skip();
    struct fl_block *block = board(&type, 0);
    pid_t process = holder(902, false, &end);
    block->service->patience_ms = 1000;
    assert_int_equal(seteuid(911), 0);
    int claimed = device_claim(block);
    assert_int_equal(seteuid(0), 0);
    assert_string_equal(block->service->failure, "");
    assert_int_equal(claimed, FL_OK);
    close(end);
    waitpid(process, NULL, 0);
    block_destroy(block);
}

int main(void)
{
    const struct CMUnitTest all[] = {
        cmocka_unit_test(a_device_is_held_by_one_process),
        cmocka_unit_test(who_waits_gets_it_from_a_process_that_ends),
        cmocka_unit_test(no_app_keeps_a_service_from_making_outputs_safe),
    };
    snprintf(name, sizeof name, "board-%d", (int)getpid());
    return cmocka_run_group_tests(all, NULL, NULL);
}
