/* A Modbus slave on libmodbus, for the tests: memory that answers, and a few registers that live.
 *
 *   slave tcp            listens on a free loopback port, prints "ready PORT"
 *   slave rtu DEVICE     sits on a serial device, prints "ready 0"
 *
 * Input registers: 0-1 twice the command as a float (big-endian words), 2 the command, 3 the last heartbeat,
 * 4 the number of requests served. Holding registers: 0 command (int16), 1 heartbeat, 10-13 gains. Coils: 0 enable.
 */
#include <arpa/inet.h>
#include <errno.h>
#include <modbus/modbus.h>
#include <netinet/in.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

static void live(modbus_mapping_t *memory)
{
    float y = 2.0f * 0.001f * (int16_t)memory->tab_registers[0];
    uint32_t bits;
    memcpy(&bits, &y, sizeof bits); /* modbus_set_float_abcd of libmodbus 3.1.6 swaps the bytes */
    memory->tab_input_registers[0] = bits >> 16;
    memory->tab_input_registers[1] = bits & 0xFFFF;
    memory->tab_input_registers[2] = memory->tab_registers[0];
    memory->tab_input_registers[3] = memory->tab_registers[1];
    memory->tab_input_registers[4]++;
}

static void serve(modbus_t *link, modbus_mapping_t *memory)
{
    uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
    for (;;) {
        int length = modbus_receive(link, request);
        if (length == -1 && errno != EMBBADCRC)
            return;
        if (length > 0) {
            live(memory);
            modbus_reply(link, request, length, memory);
        }
    }
}

int main(int count, char **words)
{
    modbus_mapping_t *memory = modbus_mapping_new(8, 8, 32, 8);
    if (count == 3 && strcmp(words[1], "rtu") == 0) {
        modbus_t *link = modbus_new_rtu(words[2], 115200, 'N', 8, 1);
        modbus_set_slave(link, 1);
        if (modbus_connect(link) == -1) {
            fprintf(stderr, "%s\n", modbus_strerror(errno));
            return 1;
        }
        printf("ready 0\n");
        fflush(stdout);
        for (;;)
            serve(link, memory);
    }
    modbus_t *link = modbus_new_tcp("127.0.0.1", 0);
    int listener = modbus_tcp_listen(link, 1);
    struct sockaddr_in address;
    socklen_t size = sizeof address;
    if (listener == -1 || getsockname(listener, (struct sockaddr *)&address, &size) == -1)
        return 1;
    printf("ready %d\n", ntohs(address.sin_port));
    fflush(stdout);
    for (;;) {
        if (modbus_tcp_accept(link, &listener) == -1)
            return 1;
        serve(link, memory);
        modbus_close(link);
    }
}
