/* An ATmega328P in simavr with a plant behind ADC0 and OC1A, in virtual time; driven from Python through ctypes. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <simavr/avr_adc.h>
#include <simavr/avr_timer.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_cycle_timers.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_io.h>
#include <simavr/sim_irq.h>

enum { ADC_FULL_MV = 5000, LINE = 1 << 20, BITS_PER_BYTE = 10, TIMER1_OVF = 13 };

/* Advance the plant by one PWM period under the duty count; return the sensor's voltage in mV. */
typedef uint32_t (*plant_callback)(uint32_t count);

typedef struct {
    avr_t *avr;
    avr_irq_t *adc, *uart_in;
    plant_callback plant;
    uint32_t byte_cycles, held;
    uint8_t to_device[LINE], from_device[LINE];
    uint32_t in_head, in_tail, out_head;
    int is_off;
} harness;

static void no_sleep(avr_t *avr, avr_cycle_count_t cycles)
{
    (void)avr;
    (void)cycles;
}

/* TCCR1A's COM1A1 connects the pin; OCR1A + 1 counts of ICR1 + 1 it is high. */
static uint32_t duty(const avr_t *avr)
{
    return avr->data[0x80] & 0x80 ? (uint32_t)(avr->data[0x88] | avr->data[0x89] << 8) + 1 : 0;
}

/* At BOTTOM, where the processor takes a new duty over: simavr itself would let it act at once. */
static void on_bottom(avr_irq_t *irq, uint32_t value, void *param)
{
    harness *h = param;
    (void)irq;
    if (value != 0) {
        avr_raise_irq(h->adc, h->plant(h->held));
        h->held = duty(h->avr);
    }
}

static avr_cycle_count_t deliver(avr_t *avr, avr_cycle_count_t when, void *param)
{
    harness *h = param;
    (void)avr;
    if (!h->is_off && h->in_head != h->in_tail)
        avr_raise_irq(h->uart_in, h->to_device[h->in_tail++ % LINE]);
    return when + h->byte_cycles;
}

static void on_byte(avr_irq_t *irq, uint32_t value, void *param)
{
    harness *h = param;
    (void)irq;
    h->from_device[h->out_head++ % LINE] = (uint8_t)value;
}

static void on_xon(avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)value;
    ((harness *)param)->is_off = 0;
}

static void on_xoff(avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)value;
    ((harness *)param)->is_off = 1;
}

harness *harness_new(const char *elf, uint32_t baud, plant_callback plant)
{
    elf_firmware_t firmware;
    harness *h = calloc(1, sizeof *h);
    uint32_t flags = 0;
    memset(&firmware, 0, sizeof firmware);
    if (h == NULL || elf_read_firmware(elf, &firmware) != 0)
        return NULL;
    h->avr = avr_make_mcu_by_name("atmega328p");
    avr_init(h->avr);
    avr_load_firmware(h->avr, &firmware);
    h->avr->frequency = 16000000;
    h->avr->vcc = h->avr->avcc = h->avr->aref = ADC_FULL_MV;
    h->avr->sleep = no_sleep;
    h->avr->log = LOG_ERROR;
    h->plant = plant;
    h->byte_cycles = h->avr->frequency / baud * BITS_PER_BYTE;
    avr_ioctl(h->avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~(uint32_t)(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
    avr_ioctl(h->avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    h->adc = avr_io_getirq(h->avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0);
    h->uart_in = avr_io_getirq(h->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(h->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_byte, h);
    avr_irq_register_notify(avr_io_getirq(h->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XON), on_xon, h);
    avr_irq_register_notify(avr_io_getirq(h->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XOFF), on_xoff, h);
    avr_irq_register_notify(avr_get_interrupt_irq(h->avr, TIMER1_OVF) + AVR_INT_IRQ_PENDING, on_bottom, h);
    avr_cycle_timer_register(h->avr, h->byte_cycles, deliver, h);
    return h;
}

/* Run until the cycle; return 0, or 1 where the processor stopped. */
int harness_run(harness *h, uint64_t until)
{
    while (h->avr->cycle < until) {
        const int state = avr_run(h->avr);
        if (state == cpu_Done || state == cpu_Crashed)
            return 1;
    }
    return 0;
}

uint32_t harness_duty(const harness *h)
{
    return duty(h->avr);
}

uint64_t harness_cycle(const harness *h)
{
    return h->avr->cycle;
}

void harness_send(harness *h, const uint8_t *data, uint32_t length)
{
    for (uint32_t i = 0; i < length; i++)
        h->to_device[h->in_head++ % LINE] = data[i];
}

/* Take up to `size` bytes that the device sent since `*tail`; return how many. */
uint32_t harness_received(const harness *h, uint32_t *tail, uint8_t *data, uint32_t size)
{
    uint32_t count = 0;
    while (*tail != h->out_head && count < size)
        data[count++] = h->from_device[(*tail)++ % LINE];
    return count;
}

void harness_reset(harness *h)
{
    avr_reset(h->avr);
    h->held = 0;
    avr_cycle_timer_register(h->avr, h->byte_cycles, deliver, h);
}
