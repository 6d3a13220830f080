/* Blocks for Simulink: what its Legacy Code Tool takes, written as MATLAB script, C header and C file. */
#ifndef FLOTILLA_LEGACY_CODE_H
#define FLOTILLA_LEGACY_CODE_H

#include "registry.h"

/* Write the files to `directory`. `words`: names of blocks, each with the values of parameters that shall be fixed
 * (NAME=VALUE) behind it; no words: all blocks that can do without. False after `registry->out` has been told why. */
bool legacy_code_write(struct registry *registry, char *const *words, int count, const char *directory);

#endif
