/* Collects what is wrong with a file, so that all of it is reported at once: "file:line: message". */
#ifndef FLOTILLA_PROBLEM_H
#define FLOTILLA_PROBLEM_H

#include <stdarg.h>
#include <stdio.h>

struct problems {
    const char *file;
    unsigned count;
    FILE *out;
};

/* `line` 0: the file as a whole. */
void problem(struct problems *problems, unsigned line, const char *format, ...) __attribute__((format(printf, 3, 4)));

#endif
