/* The same rig as an FMU of FMI 3.0, for co-simulation and model exchange. */
#include "rig_fmu.c"
#include "fmi3FunctionTypes.h"

const char *fmi3GetVersion(void) { return "3.0"; }
fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                         const fmi3ValueReference between[], size_t count, fmi3InstanceEnvironment e,
                                         fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    return strcmp(token, "{rig}") ? NULL : fmi2Instantiate(name, fmi2CoSimulation, token, "", NULL, fmi2False, fmi2False);
}
void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean defined, fmi3Float64 tolerance, fmi3Float64 t0,
                                       fmi3Boolean stops, fmi3Float64 t1)
{
    ((Rig *)c)->t = t0;
    return fmi3OK;
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Reset(fmi3Instance c) { start(c); return fmi3OK; }
fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference r[], size_t n, const fmi3Float64 v[], size_t m)
{
    return n == m && fmi2SetReal(c, r, n, v) == fmi2OK ? fmi3OK : fmi3Error;
}
fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference r[], size_t n, fmi3Float64 v[], size_t m)
{
    return n == m && fmi2GetReal(c, r, n, v) == fmi2OK ? fmi3OK : fmi3Error;
}
fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_set, fmi3Boolean *event,
                      fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
    *event = *terminate = *early = 0;
    *last = t + h;
    return fmi2DoStep(c, t, h, fmi2False) == fmi2OK ? fmi3OK : fmi3Error;
}
fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment e, fmi3LogMessageCallback log)
{
    return strcmp(token, "{rig}") ? NULL : fmi2Instantiate(name, fmi2ModelExchange, token, "", NULL, fmi2False, fmi2False);
}
fmi3Status fmi3EnterEventMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *more, fmi3Boolean *terminate, fmi3Boolean *nominals,
                                    fmi3Boolean *values, fmi3Boolean *timed, fmi3Float64 *next)
{
    *more = *terminate = *nominals = *values = *timed = 0;
    return fmi3OK;
}
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_set, fmi3Boolean *event, fmi3Boolean *terminate)
{
    *event = *terminate = 0;
    return fmi3OK;
}
fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 t) { ((Rig *)c)->t = t; return fmi3OK; }
fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n)
{
    return n == 2 && fmi2SetContinuousStates(c, x, n) == fmi2OK ? fmi3OK : fmi3Error;
}
fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n)
{
    return n == 2 && fmi2GetContinuousStates(c, x, n) == fmi2OK ? fmi3OK : fmi3Error;
}
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 d[], size_t n)
{
    return n == 2 && fmi2GetDerivatives(c, d, n) == fmi2OK ? fmi3OK : fmi3Error;
}
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n)
{
    return n == 2 && fmi2GetNominalsOfContinuousStates(c, x, n) == fmi2OK ? fmi3OK : fmi3Error;
}
fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) { *n = 2; return fmi3OK; }
fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) { *n = 0; return fmi3OK; }
fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 z[], size_t n) { return n ? fmi3Error : fmi3OK; }
/* What a tool looks up when it loads a library, and does not call. */
#define UNUSED(name) fmi3Status name(void) { return fmi3Error; }
UNUSED(fmi3ActivateModelPartition) UNUSED(fmi3DeserializeFMUState) UNUSED(fmi3EnterConfigurationMode)
UNUSED(fmi3EnterStepMode) UNUSED(fmi3EvaluateDiscreteStates) UNUSED(fmi3ExitConfigurationMode)
UNUSED(fmi3FreeFMUState) UNUSED(fmi3GetAdjointDerivative) UNUSED(fmi3GetBinary) UNUSED(fmi3GetBoolean)
UNUSED(fmi3GetClock) UNUSED(fmi3GetDirectionalDerivative) UNUSED(fmi3GetFMUState) UNUSED(fmi3GetFloat32)
UNUSED(fmi3GetInt16) UNUSED(fmi3GetInt32) UNUSED(fmi3GetInt64) UNUSED(fmi3GetInt8) UNUSED(fmi3GetIntervalDecimal)
UNUSED(fmi3GetIntervalFraction) UNUSED(fmi3GetNumberOfVariableDependencies) UNUSED(fmi3GetOutputDerivatives)
UNUSED(fmi3GetShiftDecimal) UNUSED(fmi3GetShiftFraction) UNUSED(fmi3GetString) UNUSED(fmi3GetUInt16)
UNUSED(fmi3GetUInt32) UNUSED(fmi3GetUInt64) UNUSED(fmi3GetUInt8) UNUSED(fmi3GetVariableDependencies)
UNUSED(fmi3InstantiateScheduledExecution) UNUSED(fmi3SerializeFMUState) UNUSED(fmi3SerializedFMUStateSize)
UNUSED(fmi3SetBinary) UNUSED(fmi3SetBoolean) UNUSED(fmi3SetClock) UNUSED(fmi3SetDebugLogging)
UNUSED(fmi3SetFMUState) UNUSED(fmi3SetFloat32) UNUSED(fmi3SetInt16) UNUSED(fmi3SetInt32) UNUSED(fmi3SetInt64)
UNUSED(fmi3SetInt8) UNUSED(fmi3SetIntervalDecimal) UNUSED(fmi3SetIntervalFraction) UNUSED(fmi3SetShiftDecimal)
UNUSED(fmi3SetShiftFraction) UNUSED(fmi3SetString) UNUSED(fmi3SetUInt16) UNUSED(fmi3SetUInt32) UNUSED(fmi3SetUInt64)
UNUSED(fmi3SetUInt8)
