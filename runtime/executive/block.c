/* Instances of blocks: their memory, ports and signals. */
#define _GNU_SOURCE
#include "block.h"

#include "device.h"

#include <stdlib.h>
#include <string.h>

/* A block and its small pieces: parameters, wires, scalar signals. Side by side, because what a step touches has left
 * the cache by the next one. */
struct placed {
    struct fl_block block;
    _Alignas(FL_CACHE_LINE) unsigned char near[BLOCK_NEAR];
};

static void *place(struct fl_block *block, size_t bytes)
{
    struct fl_service *service = block->service;
    size_t rounded = (bytes + 7) & ~(size_t)7; /* no piece has a type that needs more */
    if (rounded > BLOCK_NEAR - service->near_used)
        return fl_allocate(block, bytes);
    void *piece = ((struct placed *)block)->near + service->near_used;
    service->near_used += rounded;
    return piece;
}

struct fl_block *block_create(const struct fl_block_type *type, const char *name)
{
    struct fl_block *block = aligned_alloc(FL_CACHE_LINE, sizeof(struct placed));
    struct fl_service *service = calloc(1, sizeof *service);
    char *copy = strdup(name);
    if (!block || !service || !copy)
        abort();
    memset(block, 0, sizeof(struct placed));
    block->type = type;
    block->name = copy;
    block->service = service;
    block->parameters = place(block, type->parameters_size + 1);
    block->state = fl_allocate(block, type->state_size + 1);
    service->given = fl_allocate(block, type->parameter_count + 1);
    service->bounds = fl_allocate(block, sizeof *service->bounds * (type->parameter_count + 1));
    int failed = 0;
    for (uint32_t i = 0; i < type->input_count; i++)
        failed |= fl_add_input(block, type->inputs[i]);
    for (uint32_t i = 0; i < type->output_count; i++)
        failed |= fl_add_output(block, type->outputs[i]);
    if (!block->parameters || !block->state || !service->given || !service->bounds || failed)
        abort();
    return block;
}

int block_make_signals(struct fl_block *block)
{
    void **out = place(block, sizeof(void *) * (block->out_count + 1));
    const void **in = place(block, sizeof(void *) * (block->in_count + 1));
    block->service->wired = fl_allocate(block, block->in_count + 1);
    if (!out || !in || !block->service->wired)
        return FL_FAILED;
    for (uint32_t i = 0; i < block->out_count; i++)
        if (!(out[i] = place(block, fl_type_size(block->out_ports[i].type) * block->out_ports[i].width)))
            return FL_FAILED;
    /* What stays without a wire reads zero. */
    for (uint32_t i = 0; i < block->in_count; i++)
        if (!(in[i] = place(block, fl_type_size(block->in_ports[i].type) * block->in_ports[i].width)))
            return FL_FAILED;
    block->out = out;
    block->in = in;
    return FL_OK;
}

void block_wire(struct fl_block *block, uint32_t port, const void *signal)
{
    ((const void **)(uintptr_t)block->in)[port] = signal;
    block->service->wired[port] = true;
}

void block_destroy(struct fl_block *block)
{
    if (!block)
        return;
    if (block->service->destroy_inner)
        block->service->destroy_inner(block);
    device_release(block->service);
    for (struct fl_memory *memory = block->service->memory, *next; memory; memory = next) {
        next = memory->next;
        free(memory);
    }
    free(block->service);
    free((char *)(uintptr_t)block->name);
    free(block);
}
