#include "pi.h"

static real within(real low, real value, real high)
{
    if (value < low)
        return low;
    return value > high ? high : value;
}

pi_settings pi_of(real K, real Ti, real sample_time, real u_min, real u_max, real move)
{
    pi_settings settings = {K, 0, 1, u_min, u_max, move, 0};
    if (Ti < (real)1e30) {
        settings.slope = K * sample_time / Ti;
        settings.tracking = sample_time / (Ti > sample_time ? Ti : sample_time);
    }
    return settings;
}

void pi_start(pi_state *state, const pi_settings *s, real u, real r, real y)
{
    state->u = within(s->u_min, u, s->u_max);
    state->integral = state->u - s->K * (s->b * r - y) - s->slope * (r - y);
}

real pi_step(pi_state *state, const pi_settings *s, real r, real y)
{
    const real integral = state->integral + s->slope * (r - y);
    const real v = s->K * (s->b * r - y) + integral;
    const real u = within(s->u_min, within(state->u - s->move, v, state->u + s->move), s->u_max);
    state->integral = integral + s->tracking * (u - v);
    state->u = u;
    return u;
}
