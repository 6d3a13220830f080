#define _GNU_SOURCE
#include <flotilla/driver.h>
#include <stdatomic.h>

enum { LOOK_MS = 1000 };

struct fl_step_reasons {
    struct fl_block *block;
    struct fl_driver *driver;
    struct fl_reasons logged;     /* the thread's */
    _Atomic(const char *) newest; /* since the last look of the thread; NULL: none */
};

static void look(struct fl_step_reasons *reasons)
{
    const char *reason = atomic_exchange(&reasons->newest, NULL);
    if (reason)
        fl_reasons_log(&reasons->logged, reasons->block, fl_now_ns(), "%s", reason);
    else
        fl_reasons_good(&reasons->logged, fl_now_ns());
}

static void run(struct fl_driver *driver, void *context)
{
    struct fl_step_reasons *reasons = context;
    while (fl_driver_wait(driver, -1, false, LOOK_MS) == 0)
        look(reasons);
    look(reasons); /* the last step's */
}

struct fl_step_reasons *fl_step_reasons_start(struct fl_block *block)
{
    struct fl_step_reasons *reasons = fl_allocate(block, sizeof *reasons);
    if (!reasons)
        return NULL;
    reasons->block = block;
    reasons->driver = fl_driver_start_ordinary(block, run, reasons);
    return reasons->driver ? reasons : NULL;
}

void fl_step_reasons_log(struct fl_step_reasons *reasons, const char *reason)
{
    atomic_store_explicit(&reasons->newest, reason, memory_order_release);
}

void fl_step_reasons_stop(struct fl_step_reasons *reasons)
{
    if (reasons)
        fl_driver_stop(reasons->driver);
}
