/* libFuzzer's entry for the parser that SUBJECT names. */
#include "subject.h"

#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t count);

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t count)
{
    for (size_t i = 0; i < subject_count; i++) {
        if (strcmp(subjects[i].name, SUBJECT) == 0) {
            subject_run(&subjects[i], bytes, count);
            return 0;
        }
    }
    abort(); /* there is no such parser */
}
