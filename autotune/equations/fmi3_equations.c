/* The equations above between communication points, by Dormand and Prince's pair.
   Inputs are held from one communication point to the next, and arrive DELAYS seconds later. */
typedef struct {
    double t, x[STATES + 1], in[INPUTS + 1], p[PARAMETERS + 1];
    History past[INPUTS + 1];
} Model;

static void restart(Model *m)
{
    m->t = 0.0;
    memcpy(m->in, IN_0, sizeof IN_0);
    memcpy(m->x, X_0, sizeof X_0);
    memcpy(m->p, P_0, sizeof P_0);
    for (int i = 0; i < INPUTS; i++) m->past[i].count = 0;
}

/* Note what an input is from now on; the first value has been there for ever. */
static Status note(History *past, double t, double value)
{
    if (past->count && past->value[past->count - 1] == value) return OK;
    return append(past, past->count ? t : -HUGE_VAL, value);
}

/* What has arrived of every input at t, and until when that stays so, at most until an end. */
static double arrived(const Model *m, double t, double end, double *in)
{
    for (int i = 0; i < INPUTS; i++) {
        const History *past = &m->past[i];
        in[i] = m->in[i];
        if (DELAYS[i] <= 0.0 || !past->count) continue;
        size_t k = past->count - 1;
        while (k > 0 && past->t[k] + DELAYS[i] > t + 1e-12 * (1.0 + fabs(t))) k--;
        in[i] = past->value[k];
        if (k + 1 < past->count && past->t[k + 1] + DELAYS[i] < end) end = past->t[k + 1] + DELAYS[i];
    }
    return end;
}

static Status integrate(Model *m, double end, const double *in)
{
    static const double A[7][6] = {
        {0}, {1.0 / 5}, {3.0 / 40, 9.0 / 40}, {44.0 / 45, -56.0 / 15, 32.0 / 9},
        {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729},
        {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656},
        {35.0 / 384, 0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84}};
    static const double C[7] = {0, 0.2, 0.3, 0.8, 8.0 / 9, 1, 1};
    static const double WRONG[7] = {71.0 / 57600, 0, -71.0 / 16695, 71.0 / 1920, -17253.0 / 339200, 22.0 / 525, -1.0 / 40};
    double k[7][STATES + 1], x[STATES + 1], h = end - m->t, least = 1e-4 * h;
    while (m->t < end) {
        if (h > end - m->t) h = end - m->t;
        for (int s = 0; s < 7; s++) {
            for (int i = 0; i < STATES; i++) {
                x[i] = m->x[i];
                for (int j = 0; j < s; j++) x[i] += h * A[s][j] * k[j][i];
            }
            derivatives(m->t + C[s] * h, x, in, m->p, k[s]);
        }
        double worst = 0.0;
        for (int i = 0; i < STATES; i++) {
            double wrong = 0.0;
            for (int s = 0; s < 7; s++) wrong += h * WRONG[s] * k[s][i];
            wrong = fabs(wrong) / (1e-9 + 1e-7 * fmax(fabs(m->x[i]), fabs(x[i])));
            if (!(wrong <= worst)) worst = isnan(wrong) ? HUGE_VAL : wrong;
        }
        if (worst <= 1.0 || h <= least) { /* a term that switches is stepped over, not located */
            for (int i = 0; i < STATES; i++) {
                if (!isfinite(x[i])) return ERROR;
                m->x[i] = x[i];
            }
            m->t = end - m->t - h < 1e-3 * least ? end : m->t + h;
        }
        h *= worst > 0.0 ? fmin(5.0, fmax(0.2, 0.9 * pow(worst, -0.2))) : 5.0;
        if (h < least) h = least;
    }
    return OK;
}

static double read_output(Model *m)
{
    double in[INPUTS + 1];
    arrived(m, m->t, m->t, in);
    return output(m->t, m->x, in, m->p);
}

static Status advance(Model *m, double t, double step)
{
    double in[INPUTS + 1], end = t + step;
    Status status = OK;
    m->t = t;
    for (int i = 0; i < INPUTS && status == OK; i++)
        if (DELAYS[i] > 0.0) status = note(&m->past[i], t, m->in[i]);
    while (status == OK && m->t < end) {
        double until = arrived(m, m->t, end, in);
        status = integrate(m, until, in);
    }
    return status;
}

static void release(Model *m)
{
    for (int i = 0; i < INPUTS; i++) {
        free(m->past[i].t);
        free(m->past[i].value);
    }
}
