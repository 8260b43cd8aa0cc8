/* The functions by which FMI 3.0 runs what is above in co-simulation. */

/* value references: time, inputs, states, y, parameters */
enum { FIRST_STATE = 1 + INPUTS, Y = FIRST_STATE + STATES, FIRST_PARAMETER = Y + 1, END = FIRST_PARAMETER + PARAMETERS };

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, _Bool visible,
                                         _Bool logging, _Bool events, _Bool early, const Reference between[],
                                         size_t count, void *environment, void *log, void *update)
{
    if (strcmp(token, TOKEN)) return NULL;
    Model *m = calloc(1, sizeof *m);
    if (m) restart(m);
    return m;
}

EXPORT void fmi3FreeInstance(void *instance)
{
    if (instance) release(instance);
    free(instance);
}

EXPORT Status fmi3EnterInitializationMode(void *m, _Bool given, double tolerance, double start, _Bool ends, double stop)
{
    ((Model *)m)->t = start;
    return OK;
}

EXPORT Status fmi3ExitInitializationMode(void *m) { return OK; }
EXPORT Status fmi3Terminate(void *m) { return OK; }
EXPORT Status fmi3SetDebugLogging(void *m, _Bool on, size_t count, const char *const categories[]) { return OK; }

EXPORT Status fmi3Reset(void *m)
{
    restart(m);
    return OK;
}

static double *place(Model *m, Reference r)
{
    if (r >= 1 && r < FIRST_STATE) return &m->in[r - 1];
    if (r >= FIRST_STATE && r < Y) return &m->x[r - FIRST_STATE];
    return r >= FIRST_PARAMETER && r < END ? &m->p[r - FIRST_PARAMETER] : NULL;
}

EXPORT Status fmi3SetFloat64(void *m, const Reference r[], size_t n, const double values[], size_t count)
{
    for (size_t i = 0; i < n; i++) {
        double *kept = place(m, r[i]);
        if (!kept || n != count) return ERROR;
        *kept = values[i];
    }
    return OK;
}

EXPORT Status fmi3GetFloat64(void *instance, const Reference r[], size_t n, double values[], size_t count)
{
    Model *m = instance;
    for (size_t i = 0; i < n; i++) {
        double *kept = place(m, r[i]);
        if ((!kept && r[i] != 0 && r[i] != Y) || n != count) return ERROR;
        values[i] = kept ? *kept : r[i] == 0 ? m->t : read_output(m);
    }
    return OK;
}

EXPORT Status fmi3DoStep(void *instance, double t, double step, _Bool no_set, _Bool *event, _Bool *terminate,
                         _Bool *early, double *last)
{
    Model *m = instance;
    *event = *terminate = *early = 0;
    Status status = advance(m, t, step);
    *last = m->t;
    return status;
}

/* What an importer looks up when it loads the library; none of it is offered, and modelDescription.xml says so. */
#define NONE(name) EXPORT Status fmi3##name(void) { return ERROR; }
#define NO_INSTANCE(name) EXPORT void *fmi3Instantiate##name(void) { return NULL; }
NO_INSTANCE(ModelExchange) NO_INSTANCE(ScheduledExecution)
NONE(ActivateModelPartition) NONE(CompletedIntegratorStep) NONE(DeserializeFMUState) NONE(EnterConfigurationMode)
NONE(EnterContinuousTimeMode) NONE(EnterEventMode) NONE(EnterStepMode) NONE(EvaluateDiscreteStates)
NONE(ExitConfigurationMode) NONE(FreeFMUState) NONE(GetAdjointDerivative) NONE(GetBinary) NONE(GetBoolean)
NONE(GetClock) NONE(GetContinuousStateDerivatives) NONE(GetContinuousStates) NONE(GetDirectionalDerivative)
NONE(GetEventIndicators) NONE(GetFMUState) NONE(GetFloat32) NONE(GetInt16) NONE(GetInt32) NONE(GetInt64) NONE(GetInt8)
NONE(GetIntervalDecimal) NONE(GetIntervalFraction) NONE(GetNominalsOfContinuousStates)
NONE(GetNumberOfContinuousStates) NONE(GetNumberOfEventIndicators) NONE(GetNumberOfVariableDependencies)
NONE(GetOutputDerivatives) NONE(GetShiftDecimal) NONE(GetShiftFraction) NONE(GetString) NONE(GetUInt16)
NONE(GetUInt32) NONE(GetUInt64) NONE(GetUInt8) NONE(GetVariableDependencies) NONE(SerializeFMUState)
NONE(SerializedFMUStateSize) NONE(SetBinary) NONE(SetBoolean) NONE(SetClock) NONE(SetContinuousStates)
NONE(SetFMUState) NONE(SetFloat32) NONE(SetInt16) NONE(SetInt32) NONE(SetInt64) NONE(SetInt8) NONE(SetIntervalDecimal)
NONE(SetIntervalFraction) NONE(SetShiftDecimal) NONE(SetShiftFraction) NONE(SetString) NONE(SetTime) NONE(SetUInt16)
NONE(SetUInt32) NONE(SetUInt64) NONE(SetUInt8) NONE(UpdateDiscreteStates)
