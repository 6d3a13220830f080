#include "grabber.h"

#include <math.h>
#include <stdatomic.h>
#include <string.h>

enum { IMAGE, FLAG, AGE, SEQUENCE };

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
    grabber->bytes = (size_t)(width * height);
    grabber->taken_ns = fl_now_ns();
    if (frames_allocate(block, &grabber->frames, grabber->bytes) != FL_OK)
        return FL_FAILED;
    grabber->driver = fl_driver_start(block, run, grabber);
    return grabber->driver ? FL_OK : FL_FAILED;
}

void grabber_step(struct fl_block *block, struct grabber *grabber, double timeout)
{
    const struct frame *frame = frames_newest(&grabber->frames);
    if (frame) {
        memcpy(block->out[IMAGE], frame->pixels, grabber->bytes);
        grabber->taken_ns = frame->at_ns;
        grabber->sequence = frame->sequence;
    }
    int64_t age_ns = block->release_ns > grabber->taken_ns ? block->release_ns - grabber->taken_ns : 0;
    FL_OUT(block, FLAG, uint8_t) =
        grabber->sequence && atomic_load(&grabber->connected) && age_ns <= llround(timeout * 1e9);
    FL_OUT(block, AGE, double) = (double)age_ns * 1e-9;
    FL_OUT(block, SEQUENCE, uint32_t) = grabber->sequence;
}

void grabber_stop(struct grabber *grabber)
{
    fl_driver_stop(grabber->driver);
    grabber->driver = NULL;
}
