/* What the device does with ticks and requests; no register of any processor in here.
 *
 * Once per tick: device_tick. In between: device_request for each frame that came, device_report for what the device
 * says by itself. All from one thread of control. Measurement and output are counts of the converters. */
#ifndef DEVICE_H
#define DEVICE_H

#include <stdint.h>

#include "deadman.h"
#include "pi.h"
#include "relay.h"

enum { DEVICE_NOBODY, DEVICE_HOST, DEVICE_RELAY, DEVICE_REGULATOR };
enum {
    DEVICE_DEADMAN = 0x04,
    DEVICE_LIMIT = 0x08,
    DEVICE_TIME = 0x10,
    DEVICE_OVERRUN = 0x20,
    DEVICE_WATCHDOG = 0x40,
};

typedef struct {
    uint16_t ticks_per_s, y_full, u_full;
    uint16_t u_safe; /* until a host says otherwise */
    uint8_t starts, by_watchdog;
} device_setup;

typedef struct {
    uint32_t time_us;
    uint16_t y, u; /* u in effect when y was taken */
    uint8_t state;
} device_sample;

typedef struct {
    device_setup setup;
    uint16_t u, u_safe, u_min, u_max, y_low, y_high;
    uint8_t command, flags;
    deadman alive;
    uint8_t is_timed; /* whether dead-man and time end what runs */
    uint32_t ticks_left;
    uint16_t ticks_per_row, ticks_to_row, row_count; /* a row that found no room on the line is counted too */
    uint8_t row_due;
    uint32_t area, row_area; /* of u since the device's law began, in counts times ticks */
    uint8_t is_owed;         /* whether an EXCHANGE waits for the tick from which its u acts */
    uint16_t owed_to;
    device_sample last, row;
    relay_settings relay;
    relay_state relay_memory;
    real K, Ti, setpoint, load;
    pi_settings pi;
    pi_state pi_memory;
} device;

void device_start(device *d, const device_setup *setup);

/* Take a tick's measurement and the output that acts from its instant on; return the output to act from the next
 * tick on. */
uint16_t device_tick(device *d, uint32_t time_us, uint16_t y, uint16_t acting);

/* Obey a request of `length` bytes (without CRC) and write the answer's content; return its length, 0 where it comes
 * later, by device_report. The output may have changed: device_output. */
uint8_t device_request(device *d, const uint8_t *request, uint8_t length, uint8_t *answer);

uint16_t device_output(const device *d);

/* Write the content of an EXCHANGE's answer, then of a streamed row, where one is due; return its length, 0 where none
 * is. */
uint8_t device_report(device *d, uint8_t *content);

#endif
