from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.cli.served import spec_of
from autotune.config.registers import RegisterMap, RegisterSettings
from autotune.errors import InputError
from drivers.registers import MAX_WORDS, Codec, blocks
from sim.registers import from_words, to_words

ORDERS = st.sampled_from(["big", "little"])
NUMERIC = st.sampled_from(["int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"])
SCALES = st.sampled_from([1.0, 0.1, 1e-3, -0.5, 2.5, 10.0 / 4095.0])


@st.composite
def numeric_codecs(draw: st.DrawFn) -> Codec:
    register = RegisterSettings(
        address=draw(st.integers(0, 65532)),
        type=draw(NUMERIC),
        byte_order=draw(ORDERS),
        word_order=draw(ORDERS),
        scale=draw(SCALES),
        offset=draw(st.sampled_from([0.0, -40.0, 5.0])),
    )
    return Codec(name="x", register=register)


def room(codec: Codec) -> tuple[float, float]:
    """Return between which values a register is tried."""
    if codec.register.type.startswith("float"):
        return -1e6, 1e6
    low, high = codec.span  # of 64 bits a float cannot say the last
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    return (middle - 0.999 * half, middle + 0.999 * half) if codec.register.words == 4 else (low, high)


@pytest.mark.parametrize(
    ("byte_order", "word_order", "words"),
    [
        ("big", "big", (0x40A0, 0x0000)),
        ("big", "little", (0x0000, 0x40A0)),
        ("little", "big", (0xA040, 0x0000)),
        ("little", "little", (0x0000, 0xA040)),
    ],
)
def test_the_four_orders_of_a_float(byte_order: str, word_order: str, words: tuple[int, int]) -> None:
    register = RegisterSettings.model_validate(
        {"address": 0, "type": "float32", "byte_order": byte_order, "word_order": word_order}
    )
    codec = Codec(name="x", register=register)
    assert codec.encode(5.0) == words
    assert codec.decode(words) == 5.0


def test_the_example_of_the_modbus_specification() -> None:
    # Modbus Application Protocol V1.1b3, 6.3: register 108 holds 022B hex = 555
    codec = Codec(name="x", register=RegisterSettings(address=107, type="uint16"))
    assert codec.decode([0x022B]) == 555.0


@given(codec=numeric_codecs(), fraction=st.floats(0.0, 1.0))
def test_what_is_written_reads_back_within_half_a_count(codec: Codec, fraction: float) -> None:
    low, high = room(codec)
    value = low + fraction * (high - low)
    back = codec.decode(codec.encode(value))
    half_a_count = 0.5 * codec.resolution if codec.resolution else 1e-6 * (abs(value) + 50.0)
    assert abs(back - value) <= half_a_count * (1.0 + 1e-6) + 1e-15 * abs(value)


@given(codec=numeric_codecs(), fraction=st.floats(0.0, 1.0))
def test_two_codings_written_apart_agree(codec: Codec, fraction: float) -> None:
    low, high = room(codec)
    value = low + fraction * (high - low)
    words = codec.encode(value)
    spec = spec_of(codec.register)
    assert from_words(list(words), spec) == pytest.approx(codec.decode(words), rel=1e-12)
    # ties of the rounding may differ by the last count
    assert from_words(to_words(value, spec), spec) == pytest.approx(
        codec.decode(words), abs=codec.resolution * 1.0001 + 1e-9, rel=1e-6
    )


@given(codec=numeric_codecs(), beyond=st.floats(0.51, 1e6))
def test_a_value_that_does_not_fit_is_refused_and_never_clipped(codec: Codec, beyond: float) -> None:
    low, high = codec.span
    step = codec.resolution or 1e34  # beyond the largest float32
    if codec.register.type.endswith("64"):  # where a float counts in steps of 2048 and more
        step = codec.resolution * 1e4 or math.inf
    for value in (low - beyond * step, high + beyond * step):
        with pytest.raises(InputError, match=r"does not fit|is not a value"):
            codec.encode(value)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("kind", ["int16", "uint32", "float32", "bit"])
def test_what_is_no_number_is_never_written(kind: str, value: float) -> None:
    table = "coil" if kind == "bit" else "holding"
    codec = Codec(name="u", register=RegisterSettings.model_validate({"address": 0, "type": kind, "table": table}))
    with pytest.raises(InputError, match="is not a value"):
        codec.encode(value)


@pytest.mark.parametrize(
    ("kind", "words", "value"),
    [
        ("float64", (0x4009, 0x21FB, 0x5444, 0x2D18), math.pi),
        ("int64", (0xFFFF, 0xFFFF, 0xFFFF, 0xFFFE), -2.0),
        ("uint64", (0x0001, 0x0000, 0x0000, 0x0000), 2.0**48),
    ],
)
def test_values_of_four_words(kind: str, words: tuple[int, ...], value: float) -> None:
    for order, shown in (("big", words), ("little", words[::-1])):
        register = RegisterSettings.model_validate({"address": 0, "type": kind, "word_order": order})
        codec = Codec(name="x", register=register)
        assert codec.decode(shown) == value
        assert codec.encode(value) == shown


def test_a_bit_is_written_into_its_word_and_leaves_the_others() -> None:
    codec = Codec(name="enable", register=RegisterSettings.model_validate({"address": 4, "bit": 3}))
    assert codec.encode(1.0, [0xA005]) == (0xA00D,)
    assert codec.encode(0.0, [0xA00D]) == (0xA005,)
    assert [codec.decode([word]) for word in (0xA00D, 0xA005)] == [1.0, 0.0]
    with pytest.raises(InputError, match="read the word first"):
        codec.encode(1.0)


@given(
    bit=st.integers(0, 63),
    held=st.lists(st.integers(0, 0xFFFF), min_size=4, max_size=4),
    orders=st.tuples(ORDERS, ORDERS),
)
def test_any_bit_of_any_word_agrees_with_a_coding_written_apart(
    bit: int, held: list[int], orders: tuple[str, str]
) -> None:
    given_as = {"address": 0, "type": "uint64", "bit": bit, "byte_order": orders[0], "word_order": orders[1]}
    codec = Codec(name="enable", register=RegisterSettings.model_validate(given_as))
    for value in (0.0, 1.0):
        words = codec.encode(value, held)
        assert codec.decode(words) == from_words(list(words), spec_of(codec.register)) == value
        assert sum((a ^ b).bit_count() for a, b in zip(words, held, strict=True)) <= 1


@pytest.mark.parametrize(
    ("given_as", "yes", "no", "unknown"),
    [
        ({"on": 0x047F, "off": 0x0006, "type": "uint16"}, 0x047F, 0x0006, 0x0001),  # a drive's control word
        ({"on": 0}, 0, None, 5),
        ({"table": "coil", "on": 0, "off": 1}, 0, 1, None),  # an inverted coil
        ({"bit": 0, "on": 0, "off": 1}, 0, 1, None),
    ],
)
def test_codes_and_inverted_bits(given_as: dict[str, object], yes: int, no: int | None, unknown: int | None) -> None:
    if no is None:
        with pytest.raises(ValueError, match="cannot be told apart"):
            RegisterSettings.model_validate({"address": 0} | given_as)
        return
    codec = Codec(name="enable", register=RegisterSettings.model_validate({"address": 0} | given_as))
    assert codec.encode(1.0, [0]) == (yes,)
    assert codec.encode(0.0, [0]) == (no,)
    assert (codec.decode([yes]), codec.decode([no])) == (1.0, 0.0)
    if unknown is not None:
        assert codec.decode([unknown]) == 0.0


@pytest.mark.parametrize(
    ("given_as", "reason"),
    [
        ({"bit": 16}, "bit 16"),
        ({"bit": 3, "type": "int16"}, "one of a uint16"),
        ({"bit": 3, "on": 2}, "a bit is 0 or 1"),
        ({"on": 3, "scale": 0.1}, "no scale"),
        ({"on": 3, "type": "float32"}, "no float"),
    ],
)
def test_bits_and_codes_that_cannot_be_are_refused(given_as: dict[str, object], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        RegisterSettings.model_validate({"address": 0} | given_as)


def test_two_bits_share_a_word_and_nothing_else_does() -> None:
    y_and_u = {"y": {"table": "input", "address": 0}, "u": {"address": 0}}
    word = {"enable": {"address": 1, "bit": 0}, "automatic": {"address": 1, "bit": 1}}
    assert set(RegisterMap.model_validate(y_and_u | word).mapped()) == {"y", "u", "enable", "automatic"}
    for wrong in ({"automatic": {"address": 1, "bit": 0}}, {"automatic": {"address": 1}}, {"K": {"address": 1}}):
        with pytest.raises(ValueError, match=r"overlap|together"):
            RegisterMap.model_validate(y_and_u | word | wrong)


@given(codec=numeric_codecs(), ends=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)), at=st.floats(0.0, 1.0))
def test_what_is_written_of_a_command_is_never_beyond_its_limits(
    codec: Codec, ends: tuple[float, float], at: float
) -> None:
    span = room(codec)
    low, high = (span[0] + share * (span[1] - span[0]) * 1e-3 for share in sorted(ends))
    value = min(max(low + at * (high - low), low), high)
    try:
        words = codec.encode_within(value, low, high)
    except InputError:  # no count between the limits, near the value
        assert high - low < 2.0 * codec.resolution or (codec.resolution == 0.0 and high - low <= 1e-5 * abs(high))
        return
    tolerance = 1e-6 * codec.resolution + 1e-12 * max(abs(low), abs(high))
    assert low - tolerance <= codec.decode(words) <= high + tolerance


def test_a_limit_between_two_counts_is_kept() -> None:
    codec = Codec(name="u", register=RegisterSettings(address=0))
    assert codec.encode(9.6) == (10,)
    assert codec.encode_within(9.6, 0.0, 9.6) == (9,)
    assert codec.encode_within(0.4, 0.4, 9.6) == (1,)
    for wrong in (9.7, -0.1):
        with pytest.raises(InputError, match="cannot be held within"):
            codec.encode_within(wrong, 0.0, 9.6)


def test_the_count_for_no_measurement_is_no_measurement() -> None:
    codec = Codec(name="y", register=RegisterSettings(address=0, scale=0.1, not_a_value=-32768))
    assert math.isnan(codec.decode([0x8000]))
    assert codec.decode([0x7FFF]) == pytest.approx(3276.7)


def test_a_device_that_answers_nan_is_heard() -> None:
    codec = Codec(name="y", register=RegisterSettings(address=0, type="float32"))
    assert math.isnan(codec.decode(struct.unpack(">HH", struct.pack(">f", math.nan))))


@given(addresses=st.lists(st.integers(0, 400), min_size=1, max_size=30, unique=True))
def test_requests_cover_every_signal_once_and_stay_within_the_protocols_size(addresses: list[int]) -> None:
    signals = [Codec(name=str(a), register=RegisterSettings(address=a)) for a in addresses]
    found = blocks(signals)
    covered = [codec.name for block in found for codec, _ in block.parts]
    assert sorted(covered) == sorted(codec.name for codec in signals)
    assert all(block.count <= MAX_WORDS for block in found)
    assert signals[0].name in [codec.name for codec, _ in found[0].parts]  # the first signal's request goes first
    memory = {address: address for address in range(450)}
    for block in found:
        words = [memory[block.address + i] for i in range(block.count)]
        assert block.decode(words) == {codec.name: float(codec.name) for codec, _ in block.parts}


def test_a_request_touches_no_register_in_between() -> None:
    signals = [Codec(name=str(a), register=RegisterSettings(address=a)) for a in (0, 2)]
    assert [(block.address, block.count) for block in blocks(signals)] == [(0, 1), (2, 1)]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"u": {"address": 0, "table": "input"}}, "u is written by the host"),
        ({"u": {"address": 1}}, "y and u overlap at holding 1"),
        ({"K": {"address": 9}}, "K and Ti must be mapped together"),
        ({"heartbeat_echo": {"address": 9}}, "heartbeat_echo needs heartbeat"),
        ({"trial": {"address": 9}}, "trial needs heartbeat and automatic"),
        ({"y": {"address": 0, "table": "coil", "type": "int16"}}, "coils and discrete inputs hold a bit"),
        ({"y": {"address": 65535, "type": "int32"}}, "ends beyond 65535"),
        ({"y": {"address": 0, "scale": 0}}, "scale = 0"),
    ],
)
def test_a_map_that_cannot_work_is_refused(changes: dict[str, object], says: str) -> None:
    complete = {"y": {"address": 0, "type": "float32"}, "u": {"address": 5}}
    with pytest.raises(ValueError, match=says):
        RegisterMap.model_validate(complete | changes)


def test_a_coil_is_a_bit_without_being_told() -> None:
    assert RegisterSettings(table="coil", address=3).type == "bit"
