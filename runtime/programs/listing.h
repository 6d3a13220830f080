/* What blocks are, for people and for programs. */
#ifndef FLOTILLA_LISTING_H
#define FLOTILLA_LISTING_H

#include "executive/registry.h"

#include <stdio.h>

/* List the blocks that `words` name (NAME [PARAMETER=VALUE]...), with the ports that these parameters give; no words:
 * all blocks, with the ports that they have in any case. People, too, get the latter where no parameter is given.
 *
 * As JSON: a list of objects with `name`, `summary`, `source`, `inputs`, `outputs`, `parameters`, and as booleans
 * `configures` (further ports may depend on parameters), `triggers` (it can be a task's trigger) and `actuates` (it has
 * a reset state). A port has `name`, `type`, `width`, `unit`, `summary`, `optional`, `delayed`; a parameter `name`,
 * `kind`, `unit`, `summary`, `min`, `max`, `choices` (separated by '|'), `default`, `required`, `tunable`, `exclusive`,
 * `timeout`. What does not apply is left out. False after a message on `registry->out`. */
bool listing_write(struct registry *registry, char *const *words, int count, bool json, FILE *out);

#endif
