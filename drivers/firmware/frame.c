#include "frame.h"

uint16_t frame_crc(const uint8_t *data, uint8_t length)
{
    uint16_t crc = 0xFFFF;
    while (length--) {
        crc = (uint16_t)(crc ^ ((uint16_t)*data++ << 8));
        for (uint8_t bit = 0; bit < 8; bit++)
            crc = (uint16_t)(crc & 0x8000 ? (crc << 1) ^ 0x1021 : crc << 1);
    }
    return crc;
}

/* Undo the stuffing in place; return the length, 0 where the bytes are damaged. */
static uint8_t unstuff(uint8_t *piece, uint8_t length)
{
    uint8_t in = 0, out = 0;
    while (in < length) {
        const uint8_t code = piece[in++];
        if (code == 0 || in + code - 1 > length)
            return 0;
        for (uint8_t i = 1; i < code; i++)
            piece[out++] = piece[in++];
        if (in < length)
            piece[out++] = 0;
    }
    return out;
}

uint8_t frame_receive(frame_receiver *receiver, uint8_t byte)
{
    if (byte != 0) {
        if (receiver->length == sizeof receiver->piece)
            receiver->is_too_long = 1;
        else
            receiver->piece[receiver->length++] = byte;
        return 0;
    }
    uint8_t length = receiver->is_too_long ? 0 : unstuff(receiver->piece, receiver->length);
    receiver->length = receiver->is_too_long = 0;
    if (length < FRAME_HEAD + FRAME_CRC)
        return 0;
    length = (uint8_t)(length - FRAME_CRC);
    const uint16_t crc = frame_crc(receiver->piece, length);
    if (receiver->piece[length] != (uint8_t)crc || receiver->piece[length + 1] != (uint8_t)(crc >> 8))
        return 0;
    return receiver->piece[0] == FRAME_VERSION ? length : 0;
}

uint8_t frame_close(uint8_t *content, uint8_t length, uint8_t *wire)
{
    const uint16_t crc = frame_crc(content, length);
    content[length++] = (uint8_t)crc;
    content[length++] = (uint8_t)(crc >> 8);
    uint8_t code_at = 0, out = 1;
    for (uint8_t i = 0; i < length; i++) {
        if (content[i] != 0) {
            wire[out++] = content[i];
        } else {
            wire[code_at] = (uint8_t)(out - code_at);
            code_at = out++;
        }
    }
    wire[code_at] = (uint8_t)(out - code_at);
    wire[out++] = 0;
    return out;
}
