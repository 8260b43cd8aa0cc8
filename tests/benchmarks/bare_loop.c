/* A bare control loop: what this computer grants to any program that runs before the others.
 *
 *   bare_loop PERIOD SECONDS [PORT]     times in s; prints cycles, missed deadlines, and how late it was woken at worst [s]
 *
 * Absolute deadlines and nothing else; with PORT a cycle reads four input registers and writes two holding registers, as
 * the control loop's does. Deadlines are counted as there: one that has passed is missed, and the grid stays. */
#define _GNU_SOURCE
#include <modbus/modbus.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static void sleep_until(double t)
{
    struct timespec at = {(time_t)t, (long)(1e9 * (t - (time_t)t))};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
}

int main(int count, char **words)
{
    const double period = atof(words[1]), seconds = atof(words[2]);
    const struct sched_param priority = {20};
    double worst = 0.0;
    long cycles = 0, missed = 0;
    modbus_t *link = NULL;
    if (count > 3 && (!(link = modbus_new_tcp("127.0.0.1", atoi(words[3]))) || modbus_connect(link) == -1))
        return 1;
    mlockall(MCL_CURRENT | MCL_FUTURE); /* both where they are granted */
    sched_setscheduler(0, SCHED_FIFO, &priority);
    const double start = now();
    for (double deadline = start; deadline < start + seconds; cycles++) {
        uint16_t input[4], output[2] = {(uint16_t)(cycles % 1000), (uint16_t)cycles};
        deadline += period;
        const long lost = now() > deadline ? (long)((now() - deadline) / period) : 0;
        missed += lost;
        deadline += period * lost;
        sleep_until(deadline);
        worst = now() - deadline > worst ? now() - deadline : worst;
        if (link && (modbus_read_input_registers(link, 0, 4, input) != 4 ||
                     modbus_write_registers(link, 0, 2, output) != 2))
            return 2;
    }
    printf("%ld %ld %.6f\n", cycles, missed, worst);
    return 0;
}
