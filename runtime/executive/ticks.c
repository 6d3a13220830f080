#include "ticks.h"

#include <stdio.h>
#include <string.h>

#if defined(__x86_64__) || defined(__i386__)
#include <cpuid.h>

/* "Invariant TSC", Intel's manual, volume 3, section 18.17.1; AMD's, volume 3, appendix E.4.6. */
static bool invariant(void)
{
    unsigned a, b, c, d;
    return __get_cpuid(0x80000007, &a, &b, &c, &d) && d & 1u << 8;
}

/* The kernel checks the counter that it uses as its clock, and stops using it when it drifts. So this also covers older
 * processors. */
static bool keeps_time(void)
{
    char name[16] = "";
    FILE *file = fopen("/sys/devices/system/clocksource/clocksource0/current_clocksource", "re");
    bool read = file && fgets(name, sizeof name, file);
    if (file)
        fclose(file);
    return read && strcmp(name, "tsc\n") == 0;
}

bool ticks_constant(void)
{
    return keeps_time() || invariant();
}
#else
bool ticks_constant(void)
{
    return false;
}
#endif

struct moment ticks_moment(bool counter)
{
    enum { TRIES = 5 }; /* an interruption between the two clocks would be a wrong moment: take the closest pair */
    struct moment best = {0};
    int64_t closest = INT64_MAX;
    for (int i = 0; i < TRIES; i++) {
        int64_t before = ticks_now(counter), ns = fl_now_ns(), apart = ticks_now(counter) - before;
        if (apart < closest) {
            closest = apart;
            best = (struct moment){before + apart / 2, ns};
        }
    }
    return best;
}

double ticks_ns(struct moment begin, struct moment end)
{
    return end.ticks > begin.ticks ? (double)(end.ns - begin.ns) / (double)(end.ticks - begin.ticks) : 1;
}
