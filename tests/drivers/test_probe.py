"""First contact: what a wrong map looks like before anything is written."""

from __future__ import annotations

import math
import struct
import threading
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.config.registers import RegisterMap, RegisterSettings
from drivers.pace import shortest_sample_s
from drivers.ports import answers_on
from drivers.probe import implausible, probe, probe_line
from drivers.registers import Codec
from sim.modbus_rig import ModbusRig, RtuTransport, TcpTransport
from sim.serial_line import SerialLine
from sim.serial_rig import SerialRig, device_on_line
from tests.drivers.bench import (
    REGISTERS,
    U_RANGE,
    register_device,
    rtu_settings,
    serial_settings,
    servo,
    tcp_settings,
)


def codec(**settings: Any) -> Codec:
    return Codec(name="y", register=RegisterSettings.model_validate({"address": 0} | settings))


def words_of(value: float) -> tuple[int, ...]:
    return struct.unpack(">HH", struct.pack(">f", value))


@given(value=st.floats(0.5, 9.5, width=32))
def test_a_plausible_value_is_not_warned_of(value: float) -> None:
    assert implausible(codec(type="float32"), words_of(value), (0.0, 10.0)) == []


@given(value=st.floats(1.0, 9.5, width=32).filter(lambda value: value != int(value)))
def test_swapped_words_are_named_where_the_other_order_fits(value: float) -> None:
    mapped = codec(type="float32", word_order="little")
    words = words_of(value)
    if 0.0 <= mapped.decode(words) <= 10.0 and mapped.decode(words) > 1e-9:
        return  # this one fits both ways: nobody can tell
    said = implausible(mapped, words, (0.0, 10.0))
    assert any("word_order" in line and 'word_order = "big"' in line for line in said[1:])


def test_swapped_words_are_named_without_any_range_too() -> None:
    said = implausible(codec(type="float32", word_order="little"), words_of(5.25), None)
    assert 'would be 5.25 with word_order = "big"' in said


def test_an_integer_that_is_really_unsigned_is_named() -> None:
    said = implausible(codec(type="int16", scale=1e-4), [50000], (0.0, 10.0))
    assert 'would be 5 with type = "uint16"' in said


def test_a_wrong_scale_leaves_only_the_advice_to_look() -> None:
    said = implausible(codec(type="uint16", scale=1.0), [4095], (0.0, 10.0))
    assert said == ["4095, expected 0..10", "check address, scale and offset"]


def test_what_is_not_a_number_is_said() -> None:
    said = implausible(codec(type="float32"), words_of(math.nan), (0.0, 10.0))
    assert said[0].startswith("not a number")


def test_probing_reads_everything_and_writes_nothing() -> None:
    device = register_device()
    writes: list[str] = []

    def note(table: str, address: int, is_write: bool) -> None:
        if is_write:
            writes.append(table)

    before = dict(device.value)
    with ModbusRig(device, TcpTransport(), refuse=note) as server:
        found = {one.name: one for one in probe(tcp_settings(server.port), expected={"y": (-1.0, 1.0)})}
    assert set(found) == set(REGISTERS.mapped())
    assert found["K"].value == 1.5
    assert found["Ti"].value == pytest.approx(2.0)
    assert found["u_applied"].words == (100,)
    assert all(not one.warnings for one in found.values())
    assert writes == []
    assert dict(device.value) == before


def test_a_register_that_is_refused_does_not_hide_the_others() -> None:
    beyond = RegisterMap.model_validate(REGISTERS.model_dump() | {"setpoint": {"address": 500}})
    with ModbusRig(register_device(), TcpTransport()) as server:
        found = {one.name: one for one in probe(tcp_settings(server.port, beyond), expected={})}
    assert found["setpoint"].words == ()
    assert "does not have that address" in found["setpoint"].warnings[0]
    assert found["K"].value == 1.5


def test_a_device_whose_words_are_swapped_is_found_out() -> None:
    swapped = RegisterMap.model_validate(
        REGISTERS.model_dump() | {"y": {"table": "input", "address": 0, "type": "float32", "word_order": "little"}}
    )
    device = register_device()
    for _ in range(100):
        device.plant.advance(1.0, 0.01)
    with ModbusRig(device, TcpTransport()) as server:
        found = {one.name: one for one in probe(tcp_settings(server.port, swapped), expected={"y": (-5.0, 5.0)})}
    assert any('word_order = "big"' in warning for warning in found["y"].warnings)


def test_what_answers_on_a_serial_port_is_found_and_silence_is_too() -> None:
    with SerialLine() as line, ModbusRig(register_device(), RtuTransport(device=line.rig_device, parity="N")):
        assert answers_on(line.host_device, start_s=0.1) == "Modbus RTU unit 1 at 9600 bit/s, parity N"
    with SerialLine() as silent:
        assert answers_on(silent.host_device, start_s=0.1) == "nothing"


def test_a_microcontroller_is_found_and_probed_and_nothing_is_written_to_it() -> None:
    device = device_on_line(servo(), u_range=U_RANGE, u_safe=0.0, gains=(1.5, 2.0))
    came_with = dict(device.value)
    with SerialLine() as line, SerialRig(device, line.rig_device, y_span=U_RANGE, u_span=U_RANGE):
        assert answers_on(line.host_device) == "microcontroller, firmware 3, at 115200 bit/s"
        settings = serial_settings(line.host_device)
        found = probe_line(settings, expected={"y": (-1.0, 1.0)})
        wrong = probe_line(settings.model_copy(update={"y_span": (90.0, 110.0)}), expected={"y": (-1.0, 1.0)})
    assert "firmware 3, 1000 ticks per second, started 1 time(s), commanded by nobody" in found.description
    signals = {one.name: one for one in found.signals}
    assert not any(one.warnings for one in found.signals)
    assert signals["y"].value == pytest.approx(device.plant.y_true, abs=0.02)
    assert signals["u_applied"].value == pytest.approx(device.output, abs=1e-3)
    assert (signals["K"].value, signals["Ti"].value) == pytest.approx((1.5, 2.0))
    assert any("rig.y_span" in warning for one in wrong.signals for warning in one.warnings)
    assert device.value == came_with


def test_a_map_with_a_heartbeat_may_read_it_back_from_its_own_register() -> None:
    own = RegisterMap.model_validate(
        {
            name: register
            for name, register in REGISTERS.model_dump(exclude_none=True).items()
            if name not in ("heartbeat_echo", "in_command")
        }
        | {"heartbeat_echo": {"address": 1, "type": "uint16"}}
    )
    with SerialLine() as line:
        device = register_device(own)
        with ModbusRig(device, RtuTransport(device=line.rig_device, parity="N")):
            from tests.drivers.bench import rig_of

            rig = rig_of(rtu_settings(line.host_device, own))
            rig.open()
            rig.write(0.25)
            assert rig.read().u_applied == 0.25
            rig.close()


def test_a_rig_that_does_not_listen_in_time_says_so_instead_of_serving_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    released = threading.Event()
    monkeypatch.setattr("sim.modbus_rig.ModbusRig.start_s", 0.01)
    monkeypatch.setattr(ModbusRig, "_run", lambda _: released.wait())
    rig = ModbusRig(register_device(), TcpTransport())
    try:
        with pytest.raises(ConnectionError, match=r"nothing listens after 0\.01 s"), rig:
            pytest.fail(f"serves port {rig.port}")
    finally:
        released.set()


@given(st.floats(1e-5, 10.0))
def test_a_reading_and_a_command_take_half_of_the_shortest_sample_time_at_most(slowest_s: float) -> None:
    shortest_s = shortest_sample_s(slowest_s)
    assert shortest_s >= max(4.0 * slowest_s, 1e-3) * (1.0 - 1e-6)
    assert shortest_s <= max(10.0 * slowest_s, 1e-3) * (1.0 + 1e-6)
