/* No block's step makes a system call that might block. */
#define _GNU_SOURCE
#include "seccomp.h"
#include "testbed.h"

#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

static void steps(struct fl_block *block)
{
    testbed_begin(block);
    steps_under_seccomp(block, 100);
    testbed_end(block);
}

static void compute(void **state)
{
    (void)state;
    steps(testbed_block("clock", NULL));
    steps(testbed_block("command-guard", "length", "8", NULL));
    steps(testbed_block("constant", "value", "1,2", NULL));
    steps(testbed_block("delay", NULL));
    steps(testbed_block("differential-drive", "radius", "0.1", "track", "0.4", NULL));
    steps(testbed_block("differential-odometry", "radius", "0.1", "track", "0.4", NULL));
    steps(testbed_block("angles-to-quaternion", NULL));
    steps(testbed_block("gain", NULL));
    steps(testbed_block("integrator", NULL));
    steps(testbed_block("join", NULL));
    steps(testbed_block("limit", "min", "-1", "max", "1", NULL));
    steps(testbed_block("logic", NULL));
    steps(testbed_block("low-pass", "time_constant", "1", NULL));
    steps(testbed_block("pack", "types", "double", NULL));
    steps(testbed_block("pid", "kp", "1", "min", "-1", "max", "1", NULL));
    steps(testbed_block("quaternion-to-angles", NULL));
    steps(testbed_block("rotate", NULL));
    steps(testbed_block("schmitt-trigger", "on", "1", "off", "0", NULL));
    steps(testbed_block("select", NULL));
    steps(testbed_block("sum", NULL));
    steps(testbed_block("thruster-mapping", "positions", "-1,1,-1,-1,1,1,1,-1,1,-1,-1,-1,1,1,-1,1", "directions",
                        "1,0,1,0,-1,0,-1,0,0,1,0,1,0,-1,0,-1", "force", "1", "steps", "7", NULL));
    steps(testbed_block("trajectory", "waypoints", "0,1", "speed", "2", NULL));
    steps(testbed_block("unpack", "types", "double", NULL));
}

static void record(void **state)
{
    (void)state;
    char directory[] = "/tmp/test_realtime.XXXXXX", path[64];
    assert_non_null(mkdtemp(directory));
    steps(testbed_block("recorder", "directory", directory, "types", "double", "name", "log", NULL));
    snprintf(path, sizeof path, "%s/log-000001.rec", directory);
    unlink(path);
    rmdir(directory);
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(compute), cmocka_unit_test(record)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
