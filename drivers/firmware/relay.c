#include "relay.h"

void relay_start(relay_state *state)
{
    state->newest = state->readings = state->pending = 0;
    state->decided = state->level = 0;
}

uint8_t relay_accepts(const relay_settings *s)
{
    /* written so that what is not a number is refused */
    return s->amplitude > 0 && s->hysteresis >= 0 && s->delay >= 0 && s->delay <= 1e6f && s->smoothing >= 1 &&
           s->smoothing <= RELAY_SMOOTHING_MAX && (s->sign == 1 || s->sign == -1) && s->y_centre == s->y_centre &&
           s->midpoint == s->midpoint;
}

/* Mean of the last readings, the oldest first; with `smoothing` lowered on the way, of the newest ones. */
static real smoothed(relay_state *state, uint8_t smoothing, real y)
{
    state->newest = (uint8_t)((state->newest + 1) % RELAY_SMOOTHING_MAX);
    state->recent[state->newest] = y;
    if (state->readings < RELAY_SMOOTHING_MAX)
        state->readings++;
    const uint8_t count = state->readings < smoothing ? state->readings : smoothing;
    real sum = 0;
    for (uint8_t i = count; i > 0; i--)
        sum += state->recent[(uint8_t)(state->newest + RELAY_SMOOTHING_MAX - (i - 1)) % RELAY_SMOOTHING_MAX];
    return sum / count;
}

/* Mean side over this tick; what arrives in it leaves the queue, the rest comes one tick closer. */
static real mean_level(relay_state *state)
{
    real mean = 0, since = 0;
    uint8_t arrived = 0;
    while (arrived < state->pending && state->wait[arrived] < 1) {
        const real at = state->wait[arrived] > since ? state->wait[arrived] : since;
        mean += state->level * (at - since);
        since = at;
        state->level = state->side[arrived++];
    }
    mean += state->level * (1 - since);
    state->pending = (uint8_t)(state->pending - arrived);
    for (uint8_t i = 0; i < state->pending; i++) {
        state->wait[i] = state->wait[i + arrived] - 1;
        state->side[i] = state->side[i + arrived];
    }
    return mean;
}

uint8_t relay_step(relay_state *state, const relay_settings *settings, real y, real *u)
{
    const real error = settings->sign * (settings->y_centre - smoothed(state, settings->smoothing, y));
    int8_t decided = state->decided;
    if (decided == 0)
        decided = error >= 0 ? 1 : -1;
    else if (error > settings->hysteresis)
        decided = 1;
    else if (error < -settings->hysteresis)
        decided = -1;
    if (state->level == 0)
        state->level = decided;
    if (state->decided != 0 && decided != state->decided) {
        if (state->pending == RELAY_PENDING_MAX)
            return 0;
        /* decisions arrive in their order also where the delay was shortened on the way */
        real wait = settings->delay;
        if (state->pending > 0 && state->wait[state->pending - 1] > wait)
            wait = state->wait[state->pending - 1];
        state->wait[state->pending] = wait;
        state->side[state->pending++] = decided;
    }
    state->decided = decided;
    *u = settings->midpoint + settings->amplitude * mean_level(state);
    return 1;
}
