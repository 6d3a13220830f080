#include "grabber.h"

#include <stdatomic.h>
#include <string.h>

enum { IMAGE, FLAG };

int grabber_configure(struct fl_block *block, int64_t width, int64_t height)
{
    const struct fl_port outputs[] = {
        {.name = "image",
         .type = FL_UINT8,
         .width = (uint32_t)(width * height),
         .summary = "brightness of width * height pixels, row by row from the top left; 0: black"},
        FL_SENSOR_OUTPUTS,
    };
    for (size_t i = 0; i < sizeof outputs / sizeof outputs[0]; i++)
        if (fl_add_output(block, outputs[i]) != FL_OK)
            return FL_FAILED;
    return FL_OK;
}

int grabber_start(struct fl_block *block, struct grabber *grabber, int64_t width, int64_t height,
                  void (*run)(struct fl_driver *driver, void *grabber))
{
    grabber->parameters = block->parameters;
    grabber->block = block;
    grabber->bytes = (size_t)(width * height);
    fl_sensor_begin(&grabber->sensor);
    if (newest_allocate(&grabber->frames, block, sizeof(struct frame) + grabber->bytes) != FL_OK)
        return FL_FAILED;
    grabber->driver = fl_driver_start(block, run, grabber);
    return grabber->driver ? FL_OK : FL_FAILED;
}

uint8_t *grabber_pixels(struct grabber *grabber)
{
    struct frame *frame = newest_back(&grabber->frames);
    return frame->pixels;
}

void grabber_publish(struct grabber *grabber, int64_t at_ns)
{
    struct frame *frame = newest_back(&grabber->frames);
    frame->at_ns = at_ns;
    frame->sequence = ++grabber->published;
    newest_put(&grabber->frames);
    fl_reasons_good(&grabber->reasons, fl_now_ns());
}

void grabber_step(struct fl_block *block, struct grabber *grabber, double timeout)
{
    const struct frame *frame = newest_take(&grabber->frames);
    if (frame) {
        memcpy(block->out[IMAGE], frame->pixels, grabber->bytes);
        fl_sensor_update(&grabber->sensor, frame->at_ns, frame->sequence);
    }
    fl_sensor_outputs(&grabber->sensor, block, FLAG, atomic_load(&grabber->connected), timeout);
}

void grabber_stop(struct grabber *grabber)
{
    fl_driver_stop(grabber->driver);
    grabber->driver = NULL;
}
