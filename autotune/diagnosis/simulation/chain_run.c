/* The chain above between communication points: the sums of autotune/diagnosis/simulation/kernel.py, sample by sample.
   A command is held from one communication point to the next, and acts DELAY seconds later. */
enum { INPUTS = 1, COLUMNS = STATES + 3, NODES = 64 };
enum { PLANT_IN, SPEED, POSITION, OUTPUT, FIRST_LEVEL };

typedef double Matrix[STATES + 1][COLUMNS];

typedef struct {
    double t, x[STATES + 1], in[INPUTS + 1], p[PARAMETERS + 1];
    Effects effects;
    History given; /* commands, those that have long arrived left out */
    size_t at; /* the command in force is that of row `at` */
    double t_0, w, sample, step, known[4];
    Matrix table[2][NODES + 1], M[4];
    int begun;
} Model;

static void restart(Model *m)
{
    m->t = 0.0;
    m->in[0] = U_OFFSET;
    memcpy(m->x, X_0, sizeof X_0);
    memcpy(m->p, P_0, sizeof P_0);
    memset(&m->effects, 0, sizeof m->effects);
    memcpy(m->effects.numbers, NUMBERS_0, sizeof NUMBERS_0);
    m->given.count = m->at = 0;
    m->sample = 0.0;
    m->begun = 0;
}

static void release(Model *m)
{
    free(m->given.t);
    free(m->given.value);
}

/* Write exp(A i d) and its integrals times B for i = 0..NODES, d = step/NODES. */
static void tabulate(Matrix *table, double A[][STATES + 1], double B[][3], double step)
{
    double scaled[COLUMNS][COLUMNS] = {{0}}, term[COLUMNS][COLUMNS], one[COLUMNS][COLUMNS], made[COLUMNS][COLUMNS];
    double norm = 0.0, share = step / NODES;
    int halvings = 0;
    for (int i = 0; i < STATES; i++)
        for (int k = 0; k < COLUMNS; k++) scaled[i][k] = (k < STATES ? A[i][k] : B[i][k - STATES]) * share;
    for (int i = 0; i < COLUMNS; i++) {
        double sum = 0.0;
        for (int k = 0; k < COLUMNS; k++) sum += fabs(scaled[i][k]);
        norm = fmax(norm, sum);
    }
    for (; norm > 0.25; norm *= 0.5) halvings++;
    for (int i = 0; i < COLUMNS; i++)
        for (int k = 0; k < COLUMNS; k++) {
            scaled[i][k] /= pow(2.0, halvings);
            term[i][k] = one[i][k] = i == k;
        }
#define PRODUCT(left, right) \
    for (int i = 0; i < COLUMNS; i++) \
        for (int k = 0; k < COLUMNS; k++) { \
            made[i][k] = 0.0; \
            for (int l = 0; l < COLUMNS; l++) made[i][k] += left[i][l] * right[l][k]; \
        }
    for (int order = 1; order < 9; order++) {
        PRODUCT(term, scaled)
        for (int i = 0; i < COLUMNS; i++)
            for (int k = 0; k < COLUMNS; k++) one[i][k] += term[i][k] = made[i][k] / order;
    }
    for (; halvings > 0; halvings--) {
        PRODUCT(one, one)
        memcpy(one, made, sizeof one);
    }
    for (int i = 0; i < COLUMNS; i++)
        for (int k = 0; k < COLUMNS; k++) term[i][k] = i == k;
    for (int node = 0; node <= NODES; node++) {
        memcpy(table[node], term, STATES * sizeof term[0]);
        PRODUCT(term, one)
        memcpy(term, made, sizeof term);
    }
}

/* Take the sub-steps that a sample time asks for. */
static void prepare(Model *m, double sample)
{
    if (fabs(sample - m->sample) <= 1e-9 * sample) return;
    double pieces = IS_FORCED ? fmax(PIECES, ceil(FASTEST * sample / LONGEST)) : PIECES;
    m->sample = sample;
    m->step = sample / fmin(pieces, MOST_PIECES);
    tabulate(m->table[0], A, B, m->step);
    if (DIRECTIONAL) tabulate(m->table[1], A_FALLING, B_FALLING, m->step);
    for (int i = 0; i < 4; i++) m->known[i] = -1.0;
}

static void blend(Model *m, int which, double node, int slot)
{
    if (fabs(node - m->known[slot]) < 1e-8) return;
    m->known[slot] = node;
    int i = (int)(node + 1e-6), j = i < NODES ? i + 1 : NODES;
    double part = node - i > 1e-6 ? node - i : 0.0;
    for (int row = 0; row < STATES; row++)
        for (int k = 0; k < COLUMNS; k++) {
            double low = m->table[which][i][row][k];
            m->M[slot][row][k] = low + part * (m->table[which][j][row][k] - low);
        }
}

static double tap(int row, const double *x)
{
    double total = 0.0;
    for (int k = 0; k < STATES; k++) total += TAPS[row][k] * x[k];
    return total;
}

static double state_force(Model *m, const double *x, double w, double t)
{
    double plant_in = tap(PLANT_IN, x) + DIRECT_IN * w;
    return force(plant_in, tap(SPEED, x), tap(POSITION, x), tap(FIRST_LEVEL, x), t, 0.0, &m->effects);
}

/* Add to the force-free step what the forces do: Heun for smooth ones, implicit for dry friction. */
static void push(Model *m, Matrix M, double *next, double w, double t, double dt)
{
    double column[STATES + 1], end[STATES + 1], pushed = load(t + 0.5 * dt, 0.0, &m->effects), total = pushed;
    for (int i = 0; i < STATES; i++) column[i] = M[i][STATES + 1];
    if (SMOOTH) {
        double before = state_force(m, m->x, w, t);
        for (int i = 0; i < STATES; i++) end[i] = next[i] + column[i] * (before + pushed);
        travel(tap(POSITION, end) - tap(POSITION, m->x), dt, &m->effects);
        total += 0.5 * (before + state_force(m, end, w, t));
    }
    for (int i = 0; i < STATES; i++) next[i] += column[i] * total;
    if (RUBBING) {
        double level = friction(tap(SPEED, m->x), &m->effects), per_force = tap(SPEED, column);
        double rubbed = per_force == 0.0 ? 0.0 : fmin(fmax(-tap(SPEED, next) / per_force, -level), level);
        for (int i = 0; i < STATES; i++) next[i] += column[i] * rubbed;
    }
    if (DRAINING) {
        double added = outflow(tap(POSITION, m->x), tap(FIRST_LEVEL, m->x), &m->effects);
        for (int i = 0; i < STATES; i++) next[i] += M[i][STATES + 2] * added;
    }
}

static void hold_at_stop(Model *m)
{
    Pair held = stop(m->x[POSITION_STATE], SPEED_STATE >= 0 ? m->x[SPEED_STATE] : 0.0, &m->effects);
    m->x[POSITION_STATE] = held.first;
    if (SPEED_STATE >= 0) m->x[SPEED_STATE] = held.second;
}

static void sub_step(Model *m, int slot, double begun, double dt)
{
    double next[STATES + 1], t = begun - m->t_0;
    double absolute = converter(m->given.value[m->at], t, &m->effects);
    m->w = command(absolute - U_OFFSET, U_OFFSET, dt, t, 0.0, &m->effects);
    if (DIRECTIONAL && m->w < m->x[ACTUATOR]) slot += 2;
    for (int row = 0; row < STATES; row++) {
        next[row] = m->M[slot][row][STATES] * m->w;
        for (int k = 0; k < STATES; k++) next[row] += m->M[slot][row][k] * m->x[k];
    }
    if (FORCED) push(m, m->M[slot], next, m->w, t, dt);
    memcpy(m->x, next, STATES * sizeof next[0]);
    if (STOPPED) hold_at_stop(m);
}

/* Note a command; what came before the one in force is forgotten now and then. */
static Status note(Model *m, double t, double u)
{
    History *given = &m->given;
    if (m->at > 4096) {
        given->count -= m->at;
        memmove(given->t, given->t + m->at, given->count * sizeof *given->t);
        memmove(given->value, given->value + m->at, given->count * sizeof *given->value);
        m->at = 0;
    }
    return append(given, t, u);
}

/* The first command has been there for ever: what remembers commands begins with it. */
static void begin_run(Model *m)
{
    if (m->begun) return;
    m->begun = 1;
    m->t_0 = m->t;
    memcpy(m->effects.numbers + NUMBERS, m->p, PARAMETERS * sizeof m->p[0]);
    m->w = m->in[0] - U_OFFSET;
    if (!MEMORIES) return;
    Effects before = m->effects;
    for (int i = 0; i < MEMORIES; i++) before.memory[i] = m->w;
    if (REPLAYED) command(converter(m->in[0], 0.0, &before) - U_OFFSET, U_OFFSET, 0.0, 0.0, 0.0, &before);
    begin(m->w, 0.0, before.memory, &m->effects);
}

static double arrival(const Model *m)
{
    return m->at + 1 < m->given.count ? m->t_0 + (m->given.t[m->at + 1] - m->t_0) + DELAY : HUGE_VAL;
}

static Status advance(Model *m, double t, double sample)
{
    double now = t, end = t + sample;
    if (!(sample > 0.0)) return ERROR;
    m->t = t;
    begin_run(m);
    memcpy(m->effects.numbers + NUMBERS, m->p, PARAMETERS * sizeof m->p[0]);
    if (note(m, t, m->in[0]) != OK) return ERROR;
    prepare(m, sample);
    while (now < end - 1e-9 * m->step) {
        while (arrival(m) <= now + 1e-6 * m->step) m->at++;
        double comes = arrival(m), until = now < comes && comes < end ? comes : end;
        double pieces = fmax(1.0, ceil((until - now) / m->step - 1e-6)), dt = (until - now) / pieces;
        double node = fmin(dt / (m->step / NODES), NODES);
        int slot = now == t ? 0 : 1;
        blend(m, 0, node, slot);
        if (DIRECTIONAL) blend(m, 1, node, slot + 2);
        for (int piece = 0; piece < (int)pieces; piece++) sub_step(m, slot, now + piece * dt, dt);
        now = until;
    }
    for (int i = 0; i < STATES; i++)
        if (!isfinite(m->x[i])) return ERROR;
    m->t = end;
    return OK;
}

static double read_output(Model *m)
{
    double w = m->begun ? m->w : m->in[0] - U_OFFSET, since = m->begun ? m->t - m->t_0 : 0.0;
    double z = tap(OUTPUT, m->x) + DIRECT_OUT * w, through = LAW * (tap(PLANT_IN, m->x) + DIRECT_IN * w);
    memcpy(m->effects.numbers + NUMBERS, m->p, PARAMETERS * sizeof m->p[0]);
    return reading(sensor(z, since, through, &m->effects) + Y_OFFSET, since, &m->effects);
}
