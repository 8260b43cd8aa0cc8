/* A controller with a plant behind it on libmodbus, for the tests: a PI of its own in positional form, cycle 10 ms.
 *
 *   controller LAW [PORT [DEADMAN [LOG]]]    listens on the loopback, on a free port for 0, prints "ready PORT"
 *   controller LAW PORT DEADMAN - steps      the same on the reader's time: runs on to each time [s] that comes on a line
 *                                            of the standard input, and says so in a line
 *
 * LAW says how it understands its gains: ideal, swapped (words of K the other way round), minutes (T_I), percent (K of
 * an output of 0..10 over a measurement of 0..5), parallel, reversed, tenfold (set-point).
 * The plant: 1/((0.3 s + 1)(0.1 s + 1)). LOG takes a line of every cycle: time, y, output,
 * who moves it (0 nobody, 1 host, 2 own), heartbeat.
 *
 * Input registers: 0-1 y, 2-3 output, 4 last heartbeat, 5 whether the host commands. Holding registers: 0-1 u, 2
 * heartbeat, 3-4 safe output, 10-11 K, 12-13 T_I in s, 14-15 set-point, 16-17 load. Coils: 0 host commands, 1 automatic,
 * 2 trial. Floats have their high word first. Without a new heartbeat for DEADMAN seconds, half a one if not
 * given, the host loses the output, and so does its own law while a trial is on.
 */
#include <errno.h>
#include <arpa/inet.h>
#include <math.h>
#include <modbus/modbus.h>
#include <netinet/in.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#define SCAN 0.01
#define PEERS 4
enum { IDLE, HOST, OWN };
static double deadman = 0.5;
static FILE *record;

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static double get(const uint16_t *words, int swapped)
{
    uint32_t bits = (uint32_t)words[swapped ? 1 : 0] << 16 | words[swapped ? 0 : 1];
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static void put(uint16_t *words, double value)
{
    float single = (float)value;
    uint32_t bits;
    memcpy(&bits, &single, sizeof bits);
    words[0] = bits >> 16;
    words[1] = bits & 0xFFFF;
}

static double clamp(double value)
{
    return value < 0.0 ? 0.0 : value > 10.0 ? 10.0 : value;
}

static void scan(modbus_mapping_t *memory, const char *law, double t)
{
    static double x1, x2, integral, output, fed;
    static int mode = IDLE, beat = -1;
    uint16_t *held = memory->tab_registers;
    double y = x2, K = get(held + 10, strcmp(law, "swapped") == 0), Ti = get(held + 12, 0);
    double e = (strcmp(law, "tenfold") == 0 ? 10.0 : 1.0) * get(held + 14, 0) - y, load = get(held + 16, 0);
    double slope = Ti > 0.0 ? K / Ti : 0.0;
    if (strcmp(law, "minutes") == 0)
        slope /= 60.0;
    if (strcmp(law, "parallel") == 0)
        slope = Ti > 0.0 ? 1.0 / Ti : 0.0;
    if (strcmp(law, "percent") == 0)
        K *= 2.0, slope *= 2.0;
    if (strcmp(law, "reversed") == 0)
        K = -K, slope = -slope;

    int watched = memory->tab_bits[0] || memory->tab_bits[2];
    if (held[2] != beat || !watched)
        beat = held[2], fed = t;
    if (watched && t - fed > deadman)
        memory->tab_bits[0] = memory->tab_bits[1] = 0;
    int next = memory->tab_bits[0] ? HOST : memory->tab_bits[1] ? OWN : IDLE;
    if (next == OWN && mode != OWN)
        integral = output - K * e; /* without a bump */
    mode = next;
    if (mode == HOST) {
        output = clamp(get(held, 0));
    } else if (mode == IDLE) {
        output = clamp(get(held + 3, 0));
    } else {
        double wanted = K * e + integral;
        output = clamp(wanted + load);
        if (output == wanted + load || (wanted + load - output) * slope * e < 0.0)
            integral += slope * SCAN * e;
    }
    x1 += (1.0 - exp(-SCAN / 0.3)) * (output - x1);
    x2 += (1.0 - exp(-SCAN / 0.1)) * (x1 - x2);
    put(memory->tab_input_registers, x2);
    put(memory->tab_input_registers + 2, output);
    memory->tab_input_registers[4] = held[2];
    memory->tab_input_registers[5] = mode == HOST;
    if (record)
        fprintf(record, "%.6f %.9g %.9g %d %d\n", now(), (float)x2, output, mode, held[2]);
}

/* Answer one request; close the connection where the peer has. */
static void serve(modbus_t *link, modbus_mapping_t *memory, int *peer)
{
    uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
    modbus_set_socket(link, *peer);
    int length = modbus_receive(link, request);
    if (length > 0)
        modbus_reply(link, request, length, memory);
    else if (length == -1)
        close(*peer), *peer = -1;
}

int main(int count, char **words)
{
    const char *law = count > 1 ? words[1] : "ideal";
    modbus_mapping_t *memory = modbus_mapping_new(8, 8, 32, 16);
    modbus_t *link = modbus_new_tcp("127.0.0.1", count > 2 ? atoi(words[2]) : 0);
    int listener = modbus_tcp_listen(link, PEERS), peers[PEERS], oldest = 0;
    struct sockaddr_in address;
    socklen_t size = sizeof address;
    if (listener == -1 || getsockname(listener, (struct sockaddr *)&address, &size) == -1)
        return 1;
    if (count > 3)
        deadman = atof(words[3]);
    int stepped = count > 5 && strcmp(words[5], "steps") == 0;
    if (count > 4 && !stepped && (record = fopen(words[4], "a")))
        setvbuf(record, NULL, _IOLBF, 0);
    for (int i = 0; i < PEERS; i++)
        peers[i] = -1;
    put(memory->tab_registers + 10, 0.1);
    put(memory->tab_registers + 12, 1.0);
    printf("ready %d\n", ntohs(address.sin_port));
    fflush(stdout);
    double reached = 0.0; /* in steps */
    for (double next = (stepped ? 0.0 : now()) + SCAN;;) {
        double wait = next - (stepped ? reached : now());
        if (wait <= 0.0) {
            scan(memory, law, next);
            next += SCAN;
            if (stepped && next > reached)
                printf("%.6f\n", reached), fflush(stdout);
            continue;
        }
        fd_set ready;
        FD_ZERO(&ready);
        FD_SET(listener, &ready);
        if (stepped)
            FD_SET(STDIN_FILENO, &ready);
        int highest = listener;
        for (int i = 0; i < PEERS; i++)
            if (peers[i] >= 0) {
                FD_SET(peers[i], &ready);
                highest = peers[i] > highest ? peers[i] : highest;
            }
        struct timeval limit = {0, (suseconds_t)(1e6 * wait)};
        if (select(highest + 1, &ready, NULL, NULL, stepped ? NULL : &limit) <= 0)
            continue;
        if (stepped && FD_ISSET(STDIN_FILENO, &ready)) {
            if (scanf("%lf", &reached) != 1)
                return 0;
            if (next > reached)
                printf("%.6f\n", reached), fflush(stdout);
        }
        for (int i = 0; i < PEERS; i++)
            if (peers[i] >= 0 && FD_ISSET(peers[i], &ready))
                serve(link, memory, peers + i);
        if (FD_ISSET(listener, &ready)) {
            if (peers[oldest] >= 0)
                close(peers[oldest]);
            peers[oldest] = modbus_tcp_accept(link, &listener);
            oldest = (oldest + 1) % PEERS;
        }
    }
}
