/* A rig as an FMU of FMI 2.0: J dw/dt = k u - c w + load, dphi/dt = w. Co-simulation (Runge-Kutta, 1 ms) and model exchange. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include "fmi2Functions.h"

enum { U, LOAD, PHI, W, J, C, K, DPHI, DW, COUNT };
typedef struct { double v[COUNT]; double t; } Rig;

static void start(Rig *r) { memset(r, 0, sizeof *r); r->v[J] = 0.05; r->v[C] = 0.1; r->v[K] = 1.0; }
static void slopes(const Rig *r, const double *x, double *d)
{
    d[0] = x[1];
    d[1] = (r->v[K] * r->v[U] - r->v[C] * x[1] + r->v[LOAD]) / r->v[J];
}

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
fmi2Component fmi2Instantiate(fmi2String n, fmi2Type t, fmi2String g, fmi2String l, const fmi2CallbackFunctions *f,
                              fmi2Boolean v, fmi2Boolean d)
{
    Rig *r = malloc(sizeof *r);
    start(r);
    return r;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean o, size_t n, const fmi2String s[]) { return fmi2OK; }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean d, fmi2Real tol, fmi2Real t0, fmi2Boolean s, fmi2Real t1)
{
    ((Rig *)c)->t = t0;
    return fmi2OK;
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2Terminate(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2Reset(fmi2Component c) { start(c); return fmi2OK; }
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Real v[])
{
    for (size_t i = 0; i < n; i++) ((Rig *)c)->v[r[i]] = v[i];
    return fmi2OK;
}
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Real v[])
{
    Rig *rig = c;
    double x[2] = {rig->v[PHI], rig->v[W]}, d[2];
    slopes(rig, x, d);
    rig->v[DPHI] = d[0];
    rig->v[DW] = d[1];
    for (size_t i = 0; i < n; i++) v[i] = rig->v[r[i]];
    return fmi2OK;
}
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_set)
{
    Rig *r = c;
    int count = (int)ceil(h / 1e-3 - 1e-9);
    double s = h / count, x[2] = {r->v[PHI], r->v[W]}, k[4][2], y[2];
    for (int n = 0; n < count; n++) {
        slopes(r, x, k[0]);
        for (int i = 1; i < 4; i++) {
            double a = i == 3 ? s : 0.5 * s;
            y[0] = x[0] + a * k[i - 1][0];
            y[1] = x[1] + a * k[i - 1][1];
            slopes(r, y, k[i]);
        }
        for (int j = 0; j < 2; j++) x[j] += s / 6.0 * (k[0][j] + 2.0 * k[1][j] + 2.0 * k[2][j] + k[3][j]);
    }
    r->v[PHI] = x[0];
    r->v[W] = x[1];
    r->t = t + h;
    return fmi2OK;
}
fmi2Status fmi2SetTime(fmi2Component c, fmi2Real t) { ((Rig *)c)->t = t; return fmi2OK; }
fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n)
{
    ((Rig *)c)->v[PHI] = x[0];
    ((Rig *)c)->v[W] = x[1];
    return fmi2OK;
}
fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n)
{
    x[0] = ((Rig *)c)->v[PHI];
    x[1] = ((Rig *)c)->v[W];
    return fmi2OK;
}
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real d[], size_t n)
{
    double x[2] = {((Rig *)c)->v[PHI], ((Rig *)c)->v[W]};
    slopes(c, x, d);
    return fmi2OK;
}
fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n) { x[0] = x[1] = 1.0; return fmi2OK; }
fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n) { return fmi2OK; }
fmi2Status fmi2EnterEventMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *e) { memset(e, 0, sizeof *e); return fmi2OK; }
fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean n, fmi2Boolean *e, fmi2Boolean *t)
{
    *e = *t = fmi2False;
    return fmi2OK;
}
#define IDLE(name, ...) fmi2Status name(fmi2Component c, __VA_ARGS__) { return fmi2OK; }
IDLE(fmi2GetInteger, const fmi2ValueReference r[], size_t n, fmi2Integer v[])
IDLE(fmi2GetBoolean, const fmi2ValueReference r[], size_t n, fmi2Boolean v[])
IDLE(fmi2GetString, const fmi2ValueReference r[], size_t n, fmi2String v[])
IDLE(fmi2SetInteger, const fmi2ValueReference r[], size_t n, const fmi2Integer v[])
IDLE(fmi2SetBoolean, const fmi2ValueReference r[], size_t n, const fmi2Boolean v[])
IDLE(fmi2SetString, const fmi2ValueReference r[], size_t n, const fmi2String v[])
IDLE(fmi2GetFMUstate, fmi2FMUstate *s)
IDLE(fmi2SetFMUstate, fmi2FMUstate s)
IDLE(fmi2FreeFMUstate, fmi2FMUstate *s)
IDLE(fmi2SerializedFMUstateSize, fmi2FMUstate s, size_t *n)
IDLE(fmi2SerializeFMUstate, fmi2FMUstate s, fmi2Byte b[], size_t n)
IDLE(fmi2DeSerializeFMUstate, const fmi2Byte b[], size_t n, fmi2FMUstate *s)
IDLE(fmi2GetDirectionalDerivative, const fmi2ValueReference a[], size_t n, const fmi2ValueReference b[], size_t m,
     const fmi2Real d[], fmi2Real e[])
IDLE(fmi2SetRealInputDerivatives, const fmi2ValueReference r[], size_t n, const fmi2Integer o[], const fmi2Real v[])
IDLE(fmi2GetRealOutputDerivatives, const fmi2ValueReference r[], size_t n, const fmi2Integer o[], fmi2Real v[])
IDLE(fmi2GetStatus, const fmi2StatusKind k, fmi2Status *v)
IDLE(fmi2GetRealStatus, const fmi2StatusKind k, fmi2Real *v)
IDLE(fmi2GetIntegerStatus, const fmi2StatusKind k, fmi2Integer *v)
IDLE(fmi2GetBooleanStatus, const fmi2StatusKind k, fmi2Boolean *v)
IDLE(fmi2GetStringStatus, const fmi2StatusKind k, fmi2String *v)
fmi2Status fmi2CancelStep(fmi2Component c) { return fmi2OK; }
