#define _GNU_SOURCE
#include <flotilla/driver.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#define STEADY_NS (INT64_C(1000000000) * FL_REASONS_STEADY_S)

static bool is_new(struct fl_reasons *reasons, const char *reason)
{
    for (unsigned i = 0; i < reasons->count; i++)
        if (strcmp(reasons->logged[i], reason) == 0)
            return false;
    if (reasons->count == FL_REASONS)
        return false;
    memcpy(reasons->logged[reasons->count++], reason, strlen(reason) + 1);
    return true;
}

void fl_reasons_log(struct fl_reasons *reasons, struct fl_block *block, int64_t now_ns, const char *format, ...)
{
    char reason[FL_REASON_TEXT];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(reason, sizeof reason, format, arguments);
    va_end(arguments);
    reasons->wrong_ns = now_ns;
    if (is_new(reasons, reason))
        fl_warn(block, "%s", reason);
}

void fl_reasons_good(struct fl_reasons *reasons, int64_t now_ns)
{
    if (now_ns - reasons->wrong_ns >= STEADY_NS)
        reasons->count = 0;
}
