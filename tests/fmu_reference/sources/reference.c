/* Four models by the equations of the Reference FMUs (https://github.com/modelica/Reference-FMUs, 0.0.41), in one unit
 * of FMI 2.0: Dahlquist, van der Pol's oscillator, the bouncing ball and the stair, each by Euler's method with their
 * steps.
 *
 * As some tools do, it has a hyphen in its name, and leaves stdlib.h to the standard's headers.
 */
#define FMI2_FUNCTION_PREFIX Reference_Models_
#include "fmi2Functions.h"
#include <float.h>

enum { X, X0, X1, H, V, K, REALS, COUNTER = REALS, LIMIT, VARIABLES };
enum { MILLISECONDS = 1000 };

struct unit {
    double value[REALS], g;
    fmi2Integer counter, limit;
    long ms;
};

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t count, const fmi2String categories[])
{
    (void)c, (void)on, (void)count, (void)categories;
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *environment, fmi2Boolean visible, fmi2Boolean logging)
{
    struct unit *unit = calloc(1, sizeof *unit);
    (void)name, (void)type, (void)guid, (void)resources, (void)environment, (void)visible, (void)logging;
    if (unit)
        *unit = (struct unit){.value = {[X] = 1, [X0] = 2, [H] = 1, [K] = 1}, .g = -9.81, .counter = 1, .limit = 10};
    return unit;
}

void fmi2FreeInstance(fmi2Component c)
{
    free(c);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance_defined, fmi2Real tolerance, fmi2Real begin,
                               fmi2Boolean end_defined, fmi2Real end)
{
    (void)c, (void)tolerance_defined, (void)tolerance, (void)begin, (void)end_defined, (void)end;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference which[], size_t count, fmi2Real value[])
{
    for (size_t i = 0; i < count; i++)
        value[i] = ((struct unit *)c)->value[which[i]];
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference which[], size_t count, const fmi2Real value[])
{
    for (size_t i = 0; i < count; i++)
        ((struct unit *)c)->value[which[i]] = value[i];
    return fmi2OK;
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference which[], size_t count, fmi2Integer value[])
{
    const struct unit *unit = c;
    for (size_t i = 0; i < count; i++)
        value[i] = which[i] == COUNTER ? unit->counter : unit->limit;
    return fmi2OK;
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference which[], size_t count, const fmi2Integer value[])
{
    (void)which;
    for (size_t i = 0; i < count; i++)
        ((struct unit *)c)->limit = value[i];
    return fmi2OK;
}

static void bounce(struct unit *unit)
{
    double *value = unit->value, h = value[H] + 1e-3 * value[V];
    value[V] += 1e-3 * unit->g;
    value[H] = h;
    if (h <= 0 && value[V] < 0) {
        value[H] = DBL_MIN;
        value[V] *= -0.7;
        if (value[V] < 0.1)
            value[V] = unit->g = 0;
    }
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean no_setting_back)
{
    struct unit *unit = c;
    double *value = unit->value;
    const long end_ms = (long)((time + step) * MILLISECONDS + 0.5);
    (void)no_setting_back;
    while (unit->ms < end_ms) {
        unit->ms++;
        bounce(unit);
        if (unit->ms % 10 == 0) {
            const double x0 = value[X0], x1 = value[X1];
            value[X0] += 1e-2 * x1;
            value[X1] += 1e-2 * ((1 - x0 * x0) * x1 - x0);
        }
        if (unit->ms % 100 == 0)
            value[X] += 0.1 * (-value[K] * value[X]);
        if (unit->ms % MILLISECONDS == 0 && ++unit->counter >= unit->limit)
            return fmi2Discard;
    }
    return fmi2OK;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    *value = ((struct unit *)c)->counter >= ((struct unit *)c)->limit;
    return kind == fmi2Terminated ? fmi2OK : fmi2Discard;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    *value = (double)((struct unit *)c)->ms / MILLISECONDS;
    return kind == fmi2LastSuccessfulTime ? fmi2OK : fmi2Discard;
}
