"""The framed protocol: what is sent arrives, what is damaged does not, and the line recovers."""

from __future__ import annotations

import binascii
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.line_protocol import PAYLOAD, Decoder, Frame, Kind, encode, stuff, unstuff

_FIELDS = {
    "B": st.integers(0, 0xFF),
    "b": st.integers(-0x80, 0x7F),
    "H": st.integers(0, 0xFFFF),
    "I": st.integers(0, 0xFFFFFFFF),
    "f": st.floats(width=32, allow_nan=False),
}


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    kind = draw(st.sampled_from(Kind))
    values = tuple(draw(_FIELDS[code]) for code in PAYLOAD[kind].format.lstrip("<"))
    return Frame(kind=kind, sequence=draw(st.integers(0, 0xFFFF)), values=values)


@given(st.binary(max_size=600))
def test_stuffing_leaves_no_zero_and_loses_nothing(content: bytes) -> None:
    stuffed = stuff(content)
    assert 0 not in stuffed
    assert unstuff(stuffed) == content
    assert len(stuffed) <= len(content) + 1 + len(content) // 254


@pytest.mark.parametrize(
    ("content", "stuffed"),
    [  # the table in Wikipedia's article on COBS, and section 3 of Cheshire & Baker
        ("00", "0101"),
        ("0000", "010101"),
        ("11220033", "0311220233"),
        ("11223344", "0511223344"),
        ("11000000", "0211010101"),
    ],
)
def test_stuffing_agrees_with_the_published_table(content: str, stuffed: str) -> None:
    assert stuff(bytes.fromhex(content)).hex() == stuffed


def test_the_check_is_crc_16_ccitt_false() -> None:
    assert binascii.crc_hqx(b"123456789", 0xFFFF) == 0x29B1  # the catalogue's check value
    # version 2, READ, sequence 1; its CRC low byte first
    assert (
        encode(Frame(kind=Kind.READ, sequence=1)).hex()
        == "04020301" + "03" + struct.pack("<H", binascii.crc_hqx(bytes.fromhex("02030100"), 0xFFFF)).hex() + "00"
    )


@given(st.lists(frames(), max_size=6), st.data())
def test_frames_survive_being_cut_anywhere(sent: list[Frame], data: st.DataObject) -> None:
    stream = b"".join(encode(frame) for frame in sent)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    decoder = Decoder()
    received = []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        received += decoder.feed(stream[start:end])
    assert received == sent
    assert decoder.dropped == 0


@given(frames(), st.binary(max_size=200), frames())
def test_after_noise_the_next_zero_starts_afresh(before: Frame, noise: bytes, after: Frame) -> None:
    decoder = Decoder()
    received = decoder.feed(encode(before) + noise + b"\0" + encode(after))
    assert received[0] == before
    assert received[-1] == after


@given(frames(), st.data())
def test_one_flipped_bit_is_always_found(frame: Frame, data: st.DataObject) -> None:
    # flips in the content; one that makes or breaks a zero only cuts the frame elsewhere
    wire = bytearray(encode(frame))
    at = data.draw(st.integers(0, len(wire) - 2))
    wire[at] ^= 1 << data.draw(st.integers(0, 7))
    assert frame not in Decoder().feed(bytes(wire) + b"\0")


@given(frames(), st.data())
def test_half_a_frame_costs_that_frame_only(frame: Frame, data: st.DataObject) -> None:
    wire = encode(frame)
    half = wire[: data.draw(st.integers(1, len(wire) - 2))]
    decoder = Decoder()
    # the torn frame runs into the next one, the one after is whole
    assert decoder.feed(half + wire + wire)[-1] == frame
    assert decoder.dropped >= 1 or half[0] == 0


def test_a_line_that_never_ends_a_frame_keeps_no_memory() -> None:
    decoder = Decoder()
    for _ in range(1000):
        assert decoder.feed(b"\xaa" * 1000) == []
    assert decoder.feed(b"\0" + encode(Frame(kind=Kind.SAFE, sequence=7))) == [Frame(kind=Kind.SAFE, sequence=7)]
    assert decoder.dropped == 1


def test_another_version_is_told_apart_from_noise() -> None:
    content = bytes((9, 0x81, 5, 0, 1, 2, 3))
    wire = stuff(content + struct.pack("<H", binascii.crc_hqx(content, 0xFFFF))) + b"\0"
    (frame,) = Decoder().feed(wire)
    assert (frame.version, frame.sequence, frame.values) == (9, 5, ())
