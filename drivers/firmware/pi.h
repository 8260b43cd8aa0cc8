/* PI with output and rate limits; anti-windup by back-calculation, bumpless start.
 *
 *     I[k] = I[k-1] + K T_s/T_I (r[k] - y[k])
 *     v[k] = K (b r[k] - y[k]) + I[k]
 *     u[k] = v[k] held to the limits of its rate, then of u
 *     I[k] += T_s/T_t (u[k] - v[k]),   T_t = T_I, never below T_s */
#ifndef PI_H
#define PI_H

#include "real.h"

typedef struct {
    real K, slope, b;      /* slope = K T_s/T_I, 0 without integral action */
    real u_min, u_max;     /* limits of the output */
    real move;             /* largest change per tick */
    real tracking;         /* T_s/T_t, 0 without integral action */
} pi_settings;

typedef struct {
    real integral, u;
} pi_state;

/* Settings from gains in the ISA standard form; Ti and sample_time in the same unit, an infinite Ti for no I. */
pi_settings pi_of(real K, real Ti, real sample_time, real u_min, real u_max, real move);

/* Start so that the next step with the same r and y answers u, brought within the limits. */
void pi_start(pi_state *state, const pi_settings *settings, real u, real r, real y);

real pi_step(pi_state *state, const pi_settings *settings, real r, real y);

#endif
