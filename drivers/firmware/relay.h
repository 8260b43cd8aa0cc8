/* Relay with hysteresis and an inserted delay of any length (Le & Mendes 2010, figure 3 and equation (20)).
 *
 * The relay looks at the mean of the last readings and decides for a side; the decision reaches the output `delay`
 * ticks later. A switch that falls between two ticks is made by one output in between, whose area is that of the
 * switch at its exact instant. */
#ifndef RELAY_H
#define RELAY_H

#include <stdint.h>

#include "real.h"

enum { RELAY_SMOOTHING_MAX = 32, RELAY_PENDING_MAX = 8 };

typedef struct {
    real y_centre;     /* measurement to oscillate around */
    real midpoint;     /* mean of the two levels of the output */
    real amplitude;    /* half the distance between them, positive */
    real hysteresis;   /* half-width on the smoothed measurement, not negative */
    real delay;        /* from a decision to its output, in ticks, not negative */
    uint8_t smoothing; /* readings in the mean, 1 .. RELAY_SMOOTHING_MAX */
    int8_t sign;       /* of the plant's gain: 1 raises the output to raise y */
} relay_settings;

typedef struct {
    real recent[RELAY_SMOOTHING_MAX];
    real wait[RELAY_PENDING_MAX]; /* ticks until a decision arrives, counted from the present tick */
    int8_t side[RELAY_PENDING_MAX];
    uint8_t newest, readings, pending;
    int8_t decided, level; /* sides: -1, 1; 0 before the first reading */
} relay_state;

void relay_start(relay_state *state);

/* Return whether the settings can be run. */
uint8_t relay_accepts(const relay_settings *settings);

/* Take this tick's measurement and set the output to hold until the next. Return 0 where more decisions are on their
 * way than can be remembered: the output is not set then, and the caller goes safe. */
uint8_t relay_step(relay_state *state, const relay_settings *settings, real y, real *u);

#endif
