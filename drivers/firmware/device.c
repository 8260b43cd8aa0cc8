#include "device.h"

#include <string.h>

#include "frame.h"

enum {
    HELLO = 1, TAKE, READ, EXCHANGE, SAFE, RELAY, REGULATE, GET_GAINS, SET_GAINS, TRY, GET_LAW,
    INFO = 0x81, SAMPLE, GAINS, ROW, LAW, REFUSED = 0xFF
};
enum { DONE, UNKNOWN, LENGTH, NOT_IN_COMMAND, RANGE };
enum { FIRMWARE = 3 };

/* payload of each request, from HELLO on */
static const uint8_t SIZE[] = {0, 8, 0, 2, 0, 32, 14, 0, 8, 26, 0};

static uint16_t get16(const uint8_t *p)
{
    return (uint16_t)(p[0] | (uint16_t)p[1] << 8);
}

static uint32_t get32(const uint8_t *p)
{
    return get16(p) | (uint32_t)get16(p + 2) << 16;
}

static real get_real(const uint8_t *p)
{
    const uint32_t bits = get32(p);
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static uint8_t *put16(uint8_t *p, uint16_t value)
{
    *p++ = (uint8_t)value;
    *p++ = (uint8_t)(value >> 8);
    return p;
}

static uint8_t *put32(uint8_t *p, uint32_t value)
{
    return put16(put16(p, (uint16_t)value), (uint16_t)(value >> 16));
}

static uint8_t *put_real(uint8_t *p, real value)
{
    const float single = (float)value;
    uint32_t bits;
    memcpy(&bits, &single, sizeof bits);
    return put32(p, bits);
}

static uint8_t *put_sample(const device *d, uint8_t *p, const device_sample *sample)
{
    p = put16(put16(put32(p, sample->time_us), sample->y), sample->u);
    *p++ = sample->state;
    *p++ = d->setup.starts;
    return p;
}

/* What REGULATE and TAKE would start it with again. */
static uint8_t *put_law(const device *d, uint8_t *p)
{
    p = put16(put_real(p, d->setpoint), d->ticks_per_row);
    p = put16(put16(put32(p, d->is_timed ? d->ticks_left : 0), d->y_low), d->y_high);
    return put16(put16(put16(p, d->u_safe), d->u_min), d->u_max);
}

static uint8_t *put_head(uint8_t *p, uint8_t type, uint16_t sequence)
{
    *p++ = FRAME_VERSION;
    *p++ = type;
    return put16(p, sequence);
}

static uint8_t state_of(const device *d)
{
    return (uint8_t)(d->command | d->flags);
}

static void go_safe(device *d, uint8_t why)
{
    d->command = DEVICE_NOBODY;
    d->flags |= why;
    d->u = d->u_safe;
}

void device_start(device *d, const device_setup *setup)
{
    memset(d, 0, sizeof *d);
    d->setup = *setup;
    d->u = d->u_safe = setup->u_safe;
    d->u_max = setup->u_full;
    d->y_high = UINT16_MAX;
    d->Ti = 1;
    d->flags = setup->by_watchdog ? DEVICE_WATCHDOG : 0;
}

/* The nearest count within the limits of the output. */
static uint16_t nearest(const device *d, real u)
{
    if (!(u > d->u_min))
        return d->u_min;
    return u >= d->u_max ? d->u_max : (uint16_t)(u + (real)0.5);
}

static void run_law(device *d, uint16_t y)
{
    real u;
    if (y < d->y_low || y > d->y_high) {
        go_safe(d, DEVICE_LIMIT);
    } else if (d->is_timed && d->ticks_left-- == 0) {
        go_safe(d, DEVICE_TIME);
    } else if (d->command == DEVICE_REGULATOR) {
        d->u = nearest(d, pi_step(&d->pi_memory, &d->pi, d->setpoint, y) + d->load);
    } else if (relay_step(&d->relay_memory, &d->relay, y, &u)) {
        d->u = nearest(d, u);
    } else {
        go_safe(d, DEVICE_OVERRUN);
    }
}

uint16_t device_tick(device *d, uint32_t time_us, uint16_t y, uint16_t acting)
{
    const uint8_t ran = d->command;
    d->area += d->last.u; /* acted from the tick before until this one */
    d->last.time_us = time_us;
    d->last.y = y;
    d->last.u = acting;
    if (d->command != DEVICE_NOBODY && d->is_timed && deadman_tick(&d->alive))
        go_safe(d, DEVICE_DEADMAN);
    if (d->command >= DEVICE_RELAY)
        run_law(d, y);
    d->last.state = state_of(d);
    if (d->ticks_per_row != 0 && ran >= DEVICE_RELAY) {
        const uint8_t has_ended = d->command == DEVICE_NOBODY;
        if (--d->ticks_to_row == 0 || has_ended) {
            d->row = d->last;
            d->row_area = d->area;
            d->row_due = 1;
            d->row_count++;
            d->ticks_to_row = d->ticks_per_row;
        }
    }
    return d->u;
}

static void take(device *d, uint8_t command)
{
    if (d->command != command) {
        d->row_due = 0;
        d->row_count = 0;
        d->ticks_per_row = 0;
        d->area = 0;
    }
    d->command = command;
    d->flags = 0;
    d->is_timed = 1;
    deadman_feed(&d->alive);
}

static uint8_t take_by_host(device *d, const uint8_t *p)
{
    const uint16_t u_safe = get16(p), u_min = get16(p + 2), u_max = get16(p + 4);
    if (u_min > u_max || u_max > d->setup.u_full || u_safe > d->setup.u_full || get16(p + 6) == 0)
        return RANGE;
    d->u_safe = u_safe;
    d->u_min = u_min;
    d->u_max = u_max;
    deadman_arm(&d->alive, (uint32_t)get16(p + 6) * d->setup.ticks_per_s / 1000 + 1);
    d->ticks_per_row = 0;
    take(d, DEVICE_HOST);
    return DONE;
}

static void set_run(device *d, const uint8_t *p)
{
    const uint16_t ticks_per_row = get16(p);
    if (ticks_per_row != d->ticks_per_row) /* else the rows go on as they came */
        d->ticks_per_row = d->ticks_to_row = ticks_per_row;
    d->ticks_left = get32(p + 2);
    d->y_low = get16(p + 6);
    d->y_high = get16(p + 8);
}

static uint8_t start_relay(device *d, const uint8_t *p)
{
    const relay_settings s = {
        get_real(p), get_real(p + 4), get_real(p + 8), get_real(p + 12), get_real(p + 16), p[20], (int8_t)p[21],
    };
    if (d->command != DEVICE_HOST && d->command != DEVICE_RELAY)
        return NOT_IN_COMMAND;
    if (!relay_accepts(&s) || s.midpoint - s.amplitude < d->u_min || s.midpoint + s.amplitude > d->u_max)
        return RANGE;
    d->relay = s;
    if (d->command == DEVICE_HOST) /* else another setting; decisions on their way keep their arrival */
        relay_start(&d->relay_memory);
    take(d, DEVICE_RELAY);
    set_run(d, p + 22);
    return DONE;
}

static uint8_t are_gains(real K, real Ti)
{
    return K > (real)-1e30 && K < (real)1e30 && Ti > 0;
}

static void regulate(device *d, real K, real Ti, real setpoint, real load)
{
    d->setpoint = setpoint;
    d->load = load;
    d->pi = pi_of(K, Ti, (real)1 / d->setup.ticks_per_s, d->u_min - load, d->u_max - load, (real)1e30);
}

static uint8_t start_regulator(device *d, const uint8_t *p)
{
    const real setpoint = get_real(p);
    if (!(setpoint >= 0 && setpoint <= d->setup.y_full))
        return RANGE;
    regulate(d, d->K, d->Ti, setpoint, 0);
    pi_start(&d->pi_memory, &d->pi, d->u, setpoint, d->last.y);
    take(d, DEVICE_REGULATOR);
    set_run(d, p + 4);
    d->is_timed = d->ticks_left != 0;
    return DONE;
}

/* As start_regulator on gains that are not kept; once it runs, only what is asked of the law changes. */
static uint8_t start_trial(device *d, const uint8_t *p)
{
    const real K = get_real(p), Ti = get_real(p + 4), setpoint = get_real(p + 8), load = get_real(p + 12);
    if (d->command != DEVICE_HOST && d->command != DEVICE_REGULATOR)
        return NOT_IN_COMMAND;
    if (!are_gains(K, Ti) || !(setpoint >= 0 && setpoint <= d->setup.y_full) || !(load > -(real)d->setup.u_full) ||
        !(load < d->setup.u_full))
        return RANGE;
    regulate(d, K, Ti, setpoint, load);
    if (d->command == DEVICE_HOST)
        pi_start(&d->pi_memory, &d->pi, d->u - load, setpoint, d->last.y);
    take(d, DEVICE_REGULATOR);
    set_run(d, p + 16);
    return DONE;
}

static uint8_t set_gains(device *d, const uint8_t *p)
{
    const real K = get_real(p), Ti = get_real(p + 4);
    if (!are_gains(K, Ti))
        return RANGE;
    d->K = K;
    d->Ti = Ti;
    return DONE;
}

/* Do what has to be done before the answer. */
static uint8_t obey(device *d, uint8_t type, const uint8_t *payload)
{
    switch (type) {
    case TAKE:
        return take_by_host(d, payload);
    case READ:
        deadman_feed(&d->alive);
        return DONE;
    case EXCHANGE:
        if (d->command != DEVICE_HOST)
            return NOT_IN_COMMAND;
        if (get16(payload) < d->u_min || get16(payload) > d->u_max)
            return RANGE;
        d->u = get16(payload);
        deadman_feed(&d->alive);
        return DONE;
    case SAFE:
        go_safe(d, 0);
        return DONE;
    case RELAY:
        return start_relay(d, payload);
    case REGULATE:
        return start_regulator(d, payload);
    case SET_GAINS:
        return set_gains(d, payload);
    case TRY:
        return start_trial(d, payload);
    case GET_LAW:
        return d->command == DEVICE_REGULATOR ? DONE : NOT_IN_COMMAND;
    default:
        return DONE;
    }
}

uint8_t device_request(device *d, const uint8_t *request, uint8_t length, uint8_t *answer)
{
    const uint8_t type = request[1];
    const uint8_t *payload = request + FRAME_HEAD;
    const uint16_t sequence = get16(request + 2);
    uint8_t reason = DONE;
    uint8_t *p;
    if (type < HELLO || type > GET_LAW)
        reason = UNKNOWN;
    else if (length - FRAME_HEAD != SIZE[type - HELLO])
        reason = LENGTH;
    else
        reason = obey(d, type, payload);
    if (reason != DONE) {
        p = put_head(answer, REFUSED, sequence);
        *p++ = type;
        *p++ = reason;
    } else if (type == HELLO) {
        p = put16(put16(put_head(answer, INFO, sequence), FIRMWARE), d->setup.ticks_per_s);
        p = put16(put16(p, d->setup.y_full), d->setup.u_full);
        *p++ = d->setup.starts;
    } else if (type == GET_GAINS || type == SET_GAINS) {
        p = put_real(put_real(put_head(answer, GAINS, sequence), d->K), d->Ti);
    } else if (type == GET_LAW) {
        p = put_law(d, put_head(answer, LAW, sequence));
    } else if (type == EXCHANGE) {
        d->is_owed = 1;
        d->owed_to = sequence;
        p = answer;
    } else {
        d->last.state = state_of(d);
        p = put_sample(d, put_head(answer, SAMPLE, sequence), &d->last);
    }
    return (uint8_t)(p - answer);
}

uint16_t device_output(const device *d)
{
    return d->u;
}

uint8_t device_report(device *d, uint8_t *content)
{
    if (d->is_owed && (d->last.u == d->u || d->command != DEVICE_HOST)) {
        d->is_owed = 0;
        return (uint8_t)(put_sample(d, put_head(content, SAMPLE, d->owed_to), &d->last) - content);
    }
    if (!d->row_due)
        return 0;
    d->row_due = 0;
    return (uint8_t)(put32(put_sample(d, put_head(content, ROW, d->row_count), &d->row), d->row_area) - content);
}
