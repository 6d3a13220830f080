/* A block on its own, driven step by step: what a unit test of a block needs. */
#ifndef FLOTILLA_TESTBED_H
#define FLOTILLA_TESTBED_H

/* cmocka.h needs these before it. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include <cmocka.h>
#include <flotilla/block.h>

/* A block of the type named `type` with parameters "name", "value" in pairs up to NULL; a value with commas is a list.
 * Configured, with signals that the test may set through testbed_input; not started. Its period is 10 ms. */
struct fl_block *testbed_block(const char *type, ...) __attribute__((sentinel));

/* The same, where it is expected to fail: what is said. */
const char *testbed_refusal(const char *type, ...) __attribute__((sentinel));

/* start and initialize; both must succeed. */
void testbed_begin(struct fl_block *block);

/* One step, at release_ns one period later than the last. Its result. */
int testbed_step(struct fl_block *block);

/* The same, so much later than the last. */
int testbed_step_after(struct fl_block *block, int64_t interval_ns);

/* Where the test writes an input (an array of the port's type), and reads an output. By name. */
void *testbed_input(struct fl_block *block, const char *port);
const void *testbed_output(struct fl_block *block, const char *port);

#define SET(block, port, c_type, value) (*(c_type *)testbed_input(block, port) = (value))
#define GET(block, port, c_type)        (*(const c_type *)testbed_output(block, port))

/* For the block, an optional input has a wire. */
void testbed_wire(struct fl_block *block, const char *port);

/* cmocka 1.1 compares floats only. */
#define assert_near(value, expected, tolerance) testbed_near(value, expected, tolerance, __FILE__, __LINE__)
void testbed_near(double value, double expected, double tolerance, const char *file, int line);

/* terminate, and free. */
void testbed_end(struct fl_block *block);

#endif
