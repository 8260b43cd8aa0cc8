/* ATmega328P at 16 MHz, Arduino Uno: y at A0 (ADC0, 10 bits, 0 .. AVcc), u at pin 9 (OC1A, PWM 1 kHz, 0 .. 16000).
 *
 * Timer 1 counts 0 .. 15999 (mode 14): one PWM period is one tick of 1 ms. Its overflow starts the conversion, a few
 * microseconds late where another interrupt is served; the conversion's end starts the law. A new duty acts with the
 * next period, exactly one tick after the measurement it came from and at the instant of the next one: the output does
 * not jitter at all, and what a sample calls u acts from the sample's own instant on. */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <util/atomic.h>

#include "device.h"
#include "frame.h"

#ifndef BAUD
#define BAUD 115200UL
#endif
#ifndef U_SAFE
#define U_SAFE 0 /* counts of the output until a host says otherwise */
#endif

enum { TICKS_PER_S = 1000, TICK_US = 1000, Y_FULL = 1023, U_FULL = 16000, RING = 64, MARK = 0xA5 };

static volatile uint8_t ring[RING], ring_in;
static uint8_t ring_out;
static volatile uint8_t tick_due;
static volatile uint16_t measured, commanded, acting;
static volatile uint32_t ticks;
static device the_device;
static uint8_t wire[2][FRAME_WIRE_MAX];
static uint8_t wire_length[2], wire_at, wire_now; /* an answer and a row can wait */

/* survive a reset, not the loss of power */
static uint8_t starts __attribute__((section(".noinit")));
static uint8_t starts_mark __attribute__((section(".noinit")));

ISR(USART_RX_vect)
{
    const uint8_t next = (uint8_t)((ring_in + 1) % RING);
    ring[ring_in] = UDR0;
    ring_in = next; /* what overflows fails its CRC */
}

ISR(USART_UDRE_vect)
{
    UDR0 = wire[wire_now][wire_at++];
    if (wire_at == wire_length[wire_now]) {
        wire_length[wire_now] = 0;
        wire_at = 0;
        wire_now ^= 1;
        if (wire_length[wire_now] == 0)
            UCSR0B &= (uint8_t)~_BV(UDRIE0);
    }
}

ISR(TIMER1_OVF_vect)
{
    ADCSRA |= _BV(ADSC);
    acting = commanded; /* the duty was taken over when the period began */
}

ISR(ADC_vect)
{
    measured = ADC;
    ticks++;
    tick_due = 1;
}

static void output(uint16_t u)
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        commanded = u;
        if (u == 0) { /* duty 0 is the pin's own low: the shortest pulse of this mode is one count */
            TCCR1A &= (uint8_t)~_BV(COM1A1);
        } else {
            OCR1A = u - 1;
            TCCR1A |= _BV(COM1A1);
        }
    }
}

/* Hand a content over to the line; return whether there was room. */
static uint8_t send(uint8_t *content, uint8_t length)
{
    uint8_t sent = 0;
    for (uint8_t i = 0; i < 2 && !sent; i++) {
        const uint8_t slot = (uint8_t)((wire_now + i) & 1);
        if (wire_length[slot] == 0) {
            const uint8_t bytes = frame_close(content, length, wire[slot]);
            ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
            {
                if ((UCSR0B & _BV(UDRIE0)) == 0)
                    wire_now = slot;
                wire_length[slot] = bytes;
                UCSR0B |= _BV(UDRIE0);
            }
            sent = 1;
        }
    }
    return sent;
}

static void start(void)
{
    const uint8_t cause = MCUSR;
    MCUSR = 0;
    wdt_enable(WDTO_60MS);
    if (starts_mark != MARK) {
        starts_mark = MARK;
        starts = 0;
    }
    starts++;
    const device_setup setup = {
        TICKS_PER_S, Y_FULL, U_FULL, U_SAFE, starts, (cause & _BV(WDRF)) != 0,
    };
    device_start(&the_device, &setup);
    DDRB |= _BV(PB1);
    ICR1 = U_FULL - 1;
    TCCR1A = _BV(WGM11);
    TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS10);
    output(device_output(&the_device));
    ADMUX = _BV(REFS0); /* AVcc, channel 0 */
    DIDR0 = _BV(ADC0D);
    TIMSK1 = _BV(TOIE1);
    ADCSRA = _BV(ADEN) | _BV(ADIE) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0); /* 125 kHz */
    UCSR0A = _BV(U2X0);
    UBRR0 = (uint16_t)((F_CPU + 4 * BAUD) / (8 * BAUD) - 1);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
    set_sleep_mode(SLEEP_MODE_IDLE);
    sei();
}

static void tick(void)
{
    uint32_t now;
    uint16_t y, u;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        now = ticks;
        y = measured;
        u = acting;
        tick_due = 0;
    }
    output(device_tick(&the_device, now * TICK_US, y, u));
    wdt_reset();
}

int main(void)
{
    static frame_receiver receiver;
    uint8_t content[FRAME_CONTENT_MAX];
    start();
    for (;;) {
        if (tick_due)
            tick();
        if (ring_out != ring_in) {
            const uint8_t byte = ring[ring_out];
            ring_out = (uint8_t)((ring_out + 1) % RING);
            const uint8_t length = frame_receive(&receiver, byte);
            if (length != 0) {
                const uint8_t answer = device_request(&the_device, receiver.piece, length, content);
                output(device_output(&the_device));
                if (answer != 0)
                    send(content, answer);
            }
            continue;
        }
        if (wire_length[0] == 0 || wire_length[1] == 0) {
            const uint8_t report = device_report(&the_device, content);
            if (report != 0)
                send(content, report);
        }
        cli();
        if (!tick_due && ring_out == ring_in) {
            sleep_enable();
            sei();
            sleep_cpu();
            sleep_disable();
        }
        sei();
    }
}
