/* Two lags as a unit of FMI 3.0, with a variable of each kind that blocks have: T dy/dt = gain u - y, or -gain u - y.
 *
 * It is as strict as the standard lets units be: about the order of calls, the numbers of values, the step. The input
 * `status` is what a step returns; END asks for the end.
 */
#include "token.h"
#include <fmi3Functions.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { U = 1, HOLD, STATUS, Y, STEPS, LETTERS, T, GAIN, SENSE, LABEL, RAW, TICK, HELD };
enum { END = 100 };
enum state { BEGUN, INITIALIZING, STEPPING };

struct unit {
    enum state state;
    double u[LAGS], y[LAGS], t[LAGS], time;
    float gain;
    int64_t sense;
    int32_t status;
    uint16_t steps;
    bool hold, quiet;
    char label[32];
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
};

static fmi3Status no(const struct unit *unit, const char *message)
{
    if (!unit->quiet)
        unit->log(unit->environment, fmi3Error, "logStatusError", message);
    return fmi3Error;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean event_mode, fmi3Boolean early_return,
                                         const fmi3ValueReference intermediate[], size_t intermediate_count,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    char hint[16] = "";
    FILE *file = NULL;
    struct unit *unit = calloc(1, sizeof *unit);
    *unit = (struct unit){.t = {0.5, 1}, .gain = 1, .environment = environment, .log = log};
    if (resources) { /* a folder, with the separator at its end */
        char path[4096];
        snprintf(path, sizeof path, "%shint.txt", resources);
        file = fopen(path, "r");
        if (file && fgets(hint, sizeof hint, file))
            log(environment, fmi3Warning, "hint", hint);
        if (file)
            fclose(file);
    }
    if (strcmp(token, TOKEN) == 0)
        return unit;
    log(environment, fmi3Error, "logStatusError", "another token");
    free(unit);
    return NULL;
}

void fmi3FreeInstance(fmi3Instance instance)
{
    free(instance);
}

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t count, const fmi3String categories[])
{
    struct unit *unit = instance;
    unit->quiet = !on;
    return !on || (count == 1 && strcmp(categories[0], "logStatusError") == 0) ? fmi3OK : no(unit, "no such category");
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean tolerance_defined, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean stop_defined, fmi3Float64 stop)
{
    struct unit *unit = instance;
    if (unit->state != BEGUN)
        return no(unit, "initialized twice");
    unit->time = start;
    unit->state = INITIALIZING;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    struct unit *unit = instance;
    if (unit->state != INITIALIZING)
        return no(unit, "not initializing");
    unit->state = STEPPING;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance)
{
    const struct unit *unit = instance;
    return unit->state == STEPPING ? fmi3OK : no(unit, "ended before it began");
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_setting_back,
                      fmi3Boolean *event_needed, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last_time)
{
    struct unit *unit = instance;
    if (unit->state != STEPPING || fabs(time - unit->time) > 1e-9)
        return no(unit, "a step at another time");
    if (unit->status != fmi3OK && unit->status != END) {
        no(unit, "asked for it");
        return (fmi3Status)unit->status;
    }
    for (size_t i = 0; i < LAGS && !unit->hold; i++) {
        double rest = (unit->sense ? -1 : 1) * (double)unit->gain * unit->u[i];
        unit->y[i] = rest + (unit->y[i] - rest) * exp(-step / unit->t[i]);
    }
    unit->steps++;
    unit->time += step;
    *event_needed = *early = false;
    *terminate = unit->status == END;
    *last_time = unit->time;
    return fmi3OK;
}

/* Values of one variable after the other: where it lies, how many it has. */
struct place {
    fmi3ValueReference reference;
    size_t offset, width;
};

static fmi3Status move(struct unit *unit, const struct place *places, size_t place_count,
                       const fmi3ValueReference which[], size_t which_count, void *values, size_t value_count,
                       size_t size, bool set)
{
    char *value = values;
    for (size_t i = 0; i < which_count; i++) {
        size_t p = 0;
        while (p < place_count && places[p].reference != which[i])
            p++;
        if (p == place_count || places[p].width > value_count)
            return no(unit, "no such variable, or too few values");
        void *here = (char *)unit + places[p].offset;
        memcpy(set ? here : value, set ? value : here, places[p].width * size);
        value += places[p].width * size;
        value_count -= places[p].width;
    }
    return value_count ? no(unit, "too many values") : fmi3OK;
}

#define AT(name, member, width) {name, offsetof(struct unit, member), width}
#define ACCESS(type, ...)                                                                                              \
    static const struct place places_##type[] = {__VA_ARGS__};                                                         \
    fmi3Status fmi3Get##type(fmi3Instance unit, const fmi3ValueReference which[], size_t count, fmi3##type values[],   \
                             size_t value_count)                                                                       \
    {                                                                                                                  \
        return move(unit, places_##type, sizeof places_##type / sizeof(struct place), which, count, values,            \
                    value_count, sizeof values[0], false);                                                             \
    }                                                                                                                  \
    fmi3Status fmi3Set##type(fmi3Instance unit, const fmi3ValueReference which[], size_t count,                        \
                             const fmi3##type values[], size_t value_count)                                            \
    {                                                                                                                  \
        return move(unit, places_##type, sizeof places_##type / sizeof(struct place), which, count, (void *)values,    \
                    value_count, sizeof values[0], true);                                                              \
    }
ACCESS(Float64, AT(U, u, LAGS), AT(Y, y, LAGS), AT(T, t, LAGS))
ACCESS(Float32, AT(GAIN, gain, 1))
ACCESS(Int32, AT(STATUS, status, 1))
ACCESS(Int64, AT(SENSE, sense, 1))
ACCESS(UInt16, AT(STEPS, steps, 1))
ACCESS(Boolean, AT(HOLD, hold, 1), AT(HELD, hold, 1))

fmi3Status fmi3GetUInt8(fmi3Instance instance, const fmi3ValueReference which[], size_t count, fmi3UInt8 values[],
                        size_t value_count)
{
    const struct unit *unit = instance;
    values[0] = (fmi3UInt8)strlen(unit->label);
    return count == 1 && value_count == 1 && which[0] == LETTERS ? fmi3OK : no(unit, "no such variable");
}

fmi3Status fmi3SetString(fmi3Instance instance, const fmi3ValueReference which[], size_t count,
                         const fmi3String values[], size_t value_count)
{
    struct unit *unit = instance;
    snprintf(unit->label, sizeof unit->label, "%s", values[0]);
    return count == 1 && value_count == 1 && which[0] == LABEL ? fmi3OK : no(unit, "no such variable");
}
