/* Blocks for Simulink: writes what its Legacy Code Tool needs, a MATLAB script, a C header and a C file. */
#ifndef FLOTILLA_LEGACY_CODE_H
#define FLOTILLA_LEGACY_CODE_H

#include "executive/registry.h"

/* Write the files to `directory`. `words`: names of blocks, each followed by its fixed parameters (NAME=VALUE); no
 * words: all blocks without required parameters. False after a message on `registry->out`. */
bool legacy_code_write(struct registry *registry, char *const *words, int count, const char *directory);

#endif
