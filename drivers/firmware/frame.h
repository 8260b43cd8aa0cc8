/* Frames of the line protocol, see README.md: content stuffed by COBS and one zero byte, CRC-16/CCITT-FALSE. */
#ifndef FRAME_H
#define FRAME_H

#include <stdint.h>

enum { FRAME_VERSION = 2, FRAME_HEAD = 4, FRAME_CRC = 2, FRAME_CONTENT_MAX = 62, FRAME_WIRE_MAX = 64 };

typedef struct {
    uint8_t piece[FRAME_CONTENT_MAX + 1]; /* stuffed bytes since the last zero; the content once it is complete */
    uint8_t length;
    uint8_t is_too_long;
} frame_receiver;

uint16_t frame_crc(const uint8_t *data, uint8_t length);

/* Take one byte. Return the length of the content without its CRC once a frame is complete, in receiver->piece, to be
 * used before the next byte is taken; otherwise 0. */
uint8_t frame_receive(frame_receiver *receiver, uint8_t byte);

/* Close a content of `length` bytes with its CRC and write it to `wire` as it goes over the line; `content` has room
 * for the CRC. Return the number of bytes. */
uint8_t frame_close(uint8_t *content, uint8_t length, uint8_t *wire);

#endif
