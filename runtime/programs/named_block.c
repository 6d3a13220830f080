#define _GNU_SOURCE
#include "named_block.h"

#include "executive/block.h"
#include "executive/inner.h"

#include <flotilla/inner.h>
#include <stdlib.h>
#include <string.h>

enum { PERIOD_NS = 10000000 };

int named_blocks(struct registry *registry, char *const *words, int count, struct named_block *blocks)
{
    int found = 0;
    for (int i = 0; i < count; i++) {
        if (strchr(words[i], '=') && found) {
            blocks[found - 1].word_count++;
            continue;
        }
        const struct fl_block_type *type = registry_find(registry, words[i]);
        const char *nearest = type ? NULL : registry_nearest(registry, words[i]);
        if (!type) {
            fprintf(registry->out, "there is no block %s%s%s\n", words[i], nearest ? "; the nearest is " : "",
                    nearest ? nearest : "");
            return -1;
        }
        blocks[found++] = (struct named_block){.type = type, .words = words + i + 1};
    }
    return found;
}

const char *named_block_value(const struct named_block *named, const struct fl_parameter *parameter)
{
    size_t length = strlen(parameter->name);
    for (int i = 0; i < named->word_count; i++)
        if (strncmp(named->words[i], parameter->name, length) == 0 && named->words[i][length] == '=')
            return named->words[i] + length + 1;
    return NULL;
}

/* Any value, so that configure can determine the ports; the real value comes when the model starts. */
static void put_anything(struct fl_inner *inner, const struct fl_parameter *parameter)
{
    const double least = parameter->min < parameter->max ? parameter->min : 0;
    switch (parameter->kind) {
    case FL_KIND_BOOLEAN:
    case FL_KIND_INTEGER:
    case FL_KIND_UNSIGNED:
    case FL_KIND_DOUBLE:
        fl_inner_numbers(inner, parameter->name, &least, 1);
        break;
    case FL_KIND_DOUBLES:
    case FL_KIND_STRINGS:
        fl_inner_parameter(inner, parameter->name, "[]", 2);
        break;
    case FL_KIND_CHOICE:
        fl_inner_parameter(inner, parameter->name, parameter->choices, strcspn(parameter->choices, "|"));
        break;
    case FL_KIND_STRING:
    case FL_KIND_DEVICE:
        fl_inner_parameter(inner, parameter->name, "/", 1);
        break;
    }
}

bool named_block_configure(struct named_block *named, struct registry *registry, char *reason, size_t reason_size)
{
    const struct fl_block_type *type = named->type;
    named->outer = block_create(type, type->name);
    named->outer->period_ns = PERIOD_NS;
    named->outer->service->registry = registry;
    fl_inner_begin(named->outer);
    struct fl_inner *inner = fl_inner_new(type->name, 0);
    for (int i = 0; i < named->word_count; i++) {
        size_t name = strcspn(named->words[i], "=");
        char *copy = fl_allocate(named->outer, name + 1);
        if (!copy)
            abort();
        memcpy(copy, named->words[i], name);
        fl_inner_parameter(inner, copy, named->words[i] + name + 1, strlen(named->words[i] + name + 1));
    }
    for (uint32_t i = 0; i < type->parameter_count; i++)
        if (!type->parameters[i].default_value && !named_block_value(named, &type->parameters[i]))
            put_anything(inner, &type->parameters[i]);
    named->block = inner_configure(inner);
    if (named->block)
        return true;
    const char *why = strstr(named->outer->service->failure, ": "); /* behind the block's name */
    snprintf(reason, reason_size, "%s; write PARAMETER=VALUE behind the block", why ? why + 2 : "it does not fit");
    return false;
}
