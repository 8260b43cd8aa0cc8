"""The framed protocol between host and microcontroller: bytes in, frames out; no input or output of its own.

A frame is its content, stuffed by COBS so that no zero byte is left in it, and one zero byte. After noise or a lost
byte the next zero byte starts afresh. Numbers are little-endian::

    byte 0     protocol version, 2
    byte 1     type
    byte 2-3   sequence: the host's request number, repeated by its answer; in streamed rows the device's own count
    byte 4-    payload, 0 to 56 bytes
    last two   CRC-16/CCITT-FALSE over all bytes before: polynomial 1021, start FFFF, not reflected, no final xor

    host to device                                                           answer
    01 HELLO                                                                 81 INFO
    02 TAKE       u16 u_safe, u_min, u_max; u16 dead-man in ms               82 SAMPLE    the host commands; u stays
    03 READ                                                                  82 SAMPLE    feeds the dead-man
    04 EXCHANGE   u16 u                                                      82 SAMPLE    of the tick that u acts from
    05 SAFE                                                                  82 SAMPLE    u is the safe output
    06 RELAY      f32 y_centre, midpoint, amplitude, hysteresis, delay in    82 SAMPLE    then 84 ROW every n ticks
                  ticks; u8 smoothing; i8 plant sign; u16 ticks per row;
                  u32 longest time in ticks; u16 y_low, y_high; another setting while the relay runs
    07 REGULATE   f32 set-point; u16 ticks per row; u32 longest time in      82 SAMPLE    then 84 ROW every n ticks
                  ticks, 0 for ever and without dead-man; u16 y_low, y_high
    08 GET_GAINS                                                             83 GAINS
    09 SET_GAINS  f32 K in u counts per y count; f32 Ti in s                 83 GAINS     as the device holds them now
    0A TRY        f32 K, Ti, set-point, load; u16 ticks per row; u32         82 SAMPLE    then 84 ROW every n ticks
                  longest time in ticks; u16 y_low, y_high; the PI on these
                  gains with load added to u; others while it runs
    0B GET_LAW                                                               85 LAW       only while the PI runs;
                                                                             unknown to firmware before version 3

    device to host
    81 INFO       u16 firmware version; u16 ticks per second; u16 y and u count at full scale; u8 device starts
    82 SAMPLE     u32 device time in us, wraps; u16 y; u16 u that acts from y's instant on; u8 state; u8 device starts
    83 GAINS      f32 K; f32 Ti
    84 ROW        as SAMPLE; u32 area: u in counts times ticks since the device's law began, up to this tick, wraps
    85 LAW        f32 set-point; u16 ticks per row; u32 ticks left, 0 for ever; u16 y_low, y_high, u_safe, u_min, u_max
    FF REFUSED    u8 type of the request; u8 reason: 1 unknown type, 2 wrong length, 3 not in command, 4 out of range

    state: bits 0-1 who commands: 0 nobody (safe output), 1 the host, 2 the relay, 3 the device's PI
           bit 2 the dead-man ran out, bit 3 a limit on y was passed, bit 4 the time is over,
           bit 5 the relay decided faster than it could remember, bit 6 the watchdog restarted the device

What a sample says of the device's starts tells a device that restarted from one that did not.
"""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass
from enum import IntEnum

VERSION = 2
MAX_CONTENT = 62
_HEAD = struct.Struct("<BBH")
_CRC = struct.Struct("<H")


class Kind(IntEnum):
    """Types of frames."""

    HELLO = 0x01
    TAKE = 0x02
    READ = 0x03
    EXCHANGE = 0x04
    SAFE = 0x05
    RELAY = 0x06
    REGULATE = 0x07
    GET_GAINS = 0x08
    SET_GAINS = 0x09
    TRY = 0x0A
    GET_LAW = 0x0B
    INFO = 0x81
    SAMPLE = 0x82
    GAINS = 0x83
    ROW = 0x84
    LAW = 0x85
    REFUSED = 0xFF


class Command(IntEnum):
    """Who moves the actuator."""

    NOBODY = 0
    HOST = 1
    RELAY = 2
    REGULATOR = 3


#: payloads by type
PAYLOAD = {
    Kind.HELLO: struct.Struct("<"),
    Kind.TAKE: struct.Struct("<HHHH"),
    Kind.READ: struct.Struct("<"),
    Kind.EXCHANGE: struct.Struct("<H"),
    Kind.SAFE: struct.Struct("<"),
    Kind.RELAY: struct.Struct("<fffffBbHIHH"),
    Kind.REGULATE: struct.Struct("<fHIHH"),
    Kind.GET_GAINS: struct.Struct("<"),
    Kind.SET_GAINS: struct.Struct("<ff"),
    Kind.TRY: struct.Struct("<ffffHIHH"),
    Kind.GET_LAW: struct.Struct("<"),
    Kind.INFO: struct.Struct("<HHHHB"),
    Kind.SAMPLE: struct.Struct("<IHHBB"),
    Kind.GAINS: struct.Struct("<ff"),
    Kind.ROW: struct.Struct("<IHHBBI"),
    Kind.LAW: struct.Struct("<fHIHHHHH"),
    Kind.REFUSED: struct.Struct("<BB"),
}


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One frame.

    Attributes
    ----------
    kind : int
        Type; one of :class:`Kind` where the version is this one's.
    sequence : int
        Request number, 0 to 65535.
    values : tuple of float
        The payload's fields in the order of the module's table; empty for a version that is not this one's.
    version : int
        Protocol version.
    """

    kind: int
    sequence: int
    values: tuple[float, ...] = ()
    version: int = VERSION


def encode(frame: Frame) -> bytes:
    """Return a frame's bytes, the closing zero included.

    Raises
    ------
    struct.error
        A value does not fit its field.
    """
    payload = PAYLOAD[Kind(frame.kind)].pack(*frame.values)
    content = _HEAD.pack(frame.version, frame.kind, frame.sequence) + payload
    return stuff(content + _CRC.pack(binascii.crc_hqx(content, 0xFFFF))) + b"\0"


class Decoder:
    """Frames out of a stream of bytes, however it is cut and whatever noise is in it.

    Attributes
    ----------
    dropped : int
        Pieces between zero bytes that were no frame.

    Notes
    -----
    A damaged piece passes the CRC with a probability of 2^-16; its length, type and sequence have to fit besides.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._piece = bytearray()
        self._is_too_long = False

    def feed(self, data: bytes) -> list[Frame]:
        """Take bytes and return the frames that are complete with them, in their order."""
        frames = []
        *ended, rest = data.split(b"\0")
        for end in ended:
            self._gather(end)
            if self._piece or self._is_too_long:
                frame = None if self._is_too_long else _frame(bytes(self._piece))
                if frame is None:
                    self.dropped += 1
                else:
                    frames.append(frame)
            self._piece.clear()
            self._is_too_long = False
        self._gather(rest)
        return frames

    def clear(self) -> None:
        """Forget a frame that has not ended."""
        self._piece.clear()
        self._is_too_long = False

    def _gather(self, data: bytes) -> None:
        if len(self._piece) + len(data) > MAX_CONTENT + 1:
            self._is_too_long = True
            self._piece.clear()
        elif not self._is_too_long:
            self._piece += data


def stuff(content: bytes) -> bytes:
    """Return content without zero bytes (COBS: Cheshire & Baker 1999): each code byte counts to the next zero."""
    out = bytearray()
    for block in content.split(b"\0"):
        full, last = divmod(len(block), 254)
        for i in range(full):
            out += b"\xff" + block[254 * i : 254 * (i + 1)]
        out += bytes((last + 1,)) + block[254 * full :]
    return bytes(out)


def unstuff(stuffed: bytes) -> bytes | None:
    """Return what :func:`stuff` was given; None where the bytes are not its."""
    out = bytearray()
    at = 0
    while at < len(stuffed):
        code = stuffed[at]
        if code == 0 or at + code > len(stuffed):
            return None
        out += stuffed[at + 1 : at + code]
        at += code
        if code < 255 and at < len(stuffed):
            out.append(0)
    return bytes(out) if stuffed else None


def _frame(piece: bytes) -> Frame | None:
    content = unstuff(piece)
    if content is None or not _HEAD.size + _CRC.size <= len(content) <= MAX_CONTENT:
        return None
    body = content[: -_CRC.size]
    if _CRC.pack(binascii.crc_hqx(body, 0xFFFF)) != content[-_CRC.size :]:
        return None
    version, kind, sequence = _HEAD.unpack_from(body)
    if version != VERSION:
        return Frame(kind=kind, sequence=sequence, version=version)
    payload = body[_HEAD.size :]
    if kind not in PAYLOAD or len(payload) != PAYLOAD[Kind(kind)].size:
        return None
    return Frame(kind=kind, sequence=sequence, values=PAYLOAD[Kind(kind)].unpack(payload))
