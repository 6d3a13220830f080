/* A lag as a co-simulation unit of FMI 2.0, from which to begin one by hand: T dy/dt = gain u - y.
 *
 * All functions are here that the standard asks for; those for which the unit has no use say that.
 */
#define FMI2_FUNCTION_PREFIX first_lag_
#include "fmi2Functions.h"
#include <math.h>
#include <string.h>

static const char guid[] = "{6f3c1b0e-8d5a-4f0e-9a61-7c2d40b9e515}";

enum { U, Y, T, GAIN, VARIABLES };

struct lag {
    double value[VARIABLES];
    fmi2CallbackFunctions environment;
};

static const double start[VARIABLES] = {[T] = 0.5, [GAIN] = 1};

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Status fmi2SetDebugLogging(fmi2Component unit, fmi2Boolean on, size_t count, const fmi2String categories[])
{
    (void)unit, (void)on, (void)count, (void)categories;
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String wanted, fmi2String resources,
                              const fmi2CallbackFunctions *environment, fmi2Boolean visible, fmi2Boolean logging)
{
    struct lag *lag;
    (void)resources, (void)visible, (void)logging;
    if (type != fmi2CoSimulation || strcmp(wanted, guid) != 0) {
        environment->logger(environment->componentEnvironment, name, fmi2Error, "error", "the guid is %s", guid);
        return NULL;
    }
    lag = environment->allocateMemory(1, sizeof *lag);
    if (!lag)
        return NULL;
    lag->environment = *environment;
    memcpy(lag->value, start, sizeof start);
    return lag;
}

void fmi2FreeInstance(fmi2Component unit)
{
    struct lag *lag = unit;
    if (lag)
        lag->environment.freeMemory(lag);
}

fmi2Status fmi2SetupExperiment(fmi2Component unit, fmi2Boolean tolerance_defined, fmi2Real tolerance, fmi2Real begin,
                               fmi2Boolean end_defined, fmi2Real end)
{
    (void)unit, (void)tolerance_defined, (void)tolerance, (void)begin, (void)end_defined, (void)end;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component unit)
{
    (void)unit;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component unit)
{
    (void)unit;
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component unit)
{
    (void)unit;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component unit)
{
    struct lag *lag = unit;
    memcpy(lag->value, start, sizeof start);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component unit, const fmi2ValueReference which[], size_t count, fmi2Real value[])
{
    const struct lag *lag = unit;
    for (size_t i = 0; i < count; i++) {
        if (which[i] >= VARIABLES)
            return fmi2Error;
        value[i] = lag->value[which[i]];
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component unit, const fmi2ValueReference which[], size_t count, const fmi2Real value[])
{
    struct lag *lag = unit;
    for (size_t i = 0; i < count; i++) {
        if (which[i] >= VARIABLES || which[i] == Y)
            return fmi2Error;
        lag->value[which[i]] = value[i];
    }
    return fmi2OK;
}

/* Exact for an input that stays through the step. */
fmi2Status fmi2DoStep(fmi2Component unit, fmi2Real time, fmi2Real step, fmi2Boolean no_setting_back)
{
    double *value = ((struct lag *)unit)->value, rest;
    (void)time, (void)no_setting_back;
    if (!(value[T] > 0))
        return fmi2Error;
    rest = value[GAIN] * value[U];
    value[Y] = rest + (value[Y] - rest) * exp(-step / value[T]);
    return fmi2OK;
}

/* --- what it has no use for --- */

#define NONE(function, parameters)                                                                                     \
    fmi2Status function parameters                                                                                     \
    {                                                                                                                  \
        return fmi2Error;                                                                                              \
    }
#define LIST const fmi2ValueReference which[], size_t count
NONE(fmi2GetInteger, (fmi2Component unit, LIST, fmi2Integer value[]))
NONE(fmi2GetBoolean, (fmi2Component unit, LIST, fmi2Boolean value[]))
NONE(fmi2GetString, (fmi2Component unit, LIST, fmi2String value[]))
NONE(fmi2SetInteger, (fmi2Component unit, LIST, const fmi2Integer value[]))
NONE(fmi2SetBoolean, (fmi2Component unit, LIST, const fmi2Boolean value[]))
NONE(fmi2SetString, (fmi2Component unit, LIST, const fmi2String value[]))
NONE(fmi2GetFMUstate, (fmi2Component unit, fmi2FMUstate *state))
NONE(fmi2SetFMUstate, (fmi2Component unit, fmi2FMUstate state))
NONE(fmi2FreeFMUstate, (fmi2Component unit, fmi2FMUstate *state))
NONE(fmi2SerializedFMUstateSize, (fmi2Component unit, fmi2FMUstate state, size_t *size))
NONE(fmi2SerializeFMUstate, (fmi2Component unit, fmi2FMUstate state, fmi2Byte bytes[], size_t size))
NONE(fmi2DeSerializeFMUstate, (fmi2Component unit, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state))
NONE(fmi2GetDirectionalDerivative, (fmi2Component unit, LIST, const fmi2ValueReference known[], size_t known_count,
                                    const fmi2Real known_change[], fmi2Real change[]))
NONE(fmi2SetRealInputDerivatives, (fmi2Component unit, LIST, const fmi2Integer order[], const fmi2Real value[]))
NONE(fmi2GetRealOutputDerivatives, (fmi2Component unit, LIST, const fmi2Integer order[], fmi2Real value[]))
NONE(fmi2CancelStep, (fmi2Component unit))
NONE(fmi2GetStatus, (fmi2Component unit, const fmi2StatusKind kind, fmi2Status *value))
NONE(fmi2GetRealStatus, (fmi2Component unit, const fmi2StatusKind kind, fmi2Real *value))
NONE(fmi2GetIntegerStatus, (fmi2Component unit, const fmi2StatusKind kind, fmi2Integer *value))
NONE(fmi2GetBooleanStatus, (fmi2Component unit, const fmi2StatusKind kind, fmi2Boolean *value))
NONE(fmi2GetStringStatus, (fmi2Component unit, const fmi2StatusKind kind, fmi2String *value))
