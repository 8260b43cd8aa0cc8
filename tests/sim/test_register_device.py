"""The simulated device in time that the test tells: who moves the actuator, and when."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.register_device import IllegalAddress, RegisterDevice
from sim.registers import RegisterSpec, Table
from sim.servo import Servo, ServoSettings

SAFE = -1.0
REGISTERS = {
    "y": RegisterSpec(table="input", address=0, type="float32"),
    "u_applied": RegisterSpec(table="input", address=2, scale=1e-3),
    "u": RegisterSpec(table="holding", address=0, scale=1e-3),
    "heartbeat": RegisterSpec(table="holding", address=1, type="uint16"),
    "enable": RegisterSpec(table="coil", address=0, type="bit"),
    "automatic": RegisterSpec(table="coil", address=1, type="bit"),
    "setpoint": RegisterSpec(table="holding", address=2, scale=1e-3),
    "K": RegisterSpec(table="holding", address=10, type="float32"),
    "Ti": RegisterSpec(table="holding", address=12, type="float32"),
}


def device(*, without: str = "", gains: tuple[float, float] = (2.0, 0.5)) -> RegisterDevice:
    registers = {name: spec for name, spec in REGISTERS.items() if name != without}
    plant = Servo(ServoSettings(noise=0.0, resolution=0.0))
    return RegisterDevice(plant, registers, u_safe=SAFE, u_range=(-10.0, 10.0), deadman_s=0.5, gains=gains)


def take_command(box: RegisterDevice, u_mV: int, now_s: float) -> None:
    box.write("holding", 0, [u_mV], now_s)
    box.write("coil", 0, [1], now_s)


def test_a_command_acts_only_once_the_host_is_enabled() -> None:
    box = device()
    box.write("holding", 0, [2000], 1.0)
    assert box.output == 0.0
    box.write("coil", 0, [1], 1.0)
    assert box.output == 2.0


@given(beats=st.lists(st.floats(0.0, 0.49), min_size=1, max_size=20))
def test_the_dead_man_counts_from_the_last_new_heartbeat_to_the_microsecond(beats: list[float]) -> None:
    box = device()
    take_command(box, 2000, 0.0)
    now_s = 0.0
    for k, wait_s in enumerate(beats):
        now_s += wait_s
        box.write("holding", 1, [k + 1], now_s)
    box.live(now_s + 10.0)
    assert box.output == SAFE
    assert box.history[-1].cause == "dead-man"
    assert box.history[-1].t_s == pytest.approx(now_s + 0.5, abs=1e-9)


def test_a_heartbeat_that_stands_still_is_no_sign_of_life() -> None:
    box = device()
    take_command(box, 2000, 0.0)
    for k in range(20):
        box.write("holding", 1, [0], 0.1 * k)
    assert box.output == SAFE
    assert box.history[-1].t_s == pytest.approx(0.5)


def test_without_a_heartbeat_register_commands_are_the_sign_of_life() -> None:
    box = device(without="heartbeat")
    take_command(box, 2000, 0.0)
    for k in range(20):
        box.write("holding", 0, [2000], 0.4 * k)
    assert box.output == 2.0
    box.live(0.4 * 19 + 0.6)
    assert box.output == SAFE


def test_after_the_dead_man_the_host_must_be_enabled_anew() -> None:
    box = device()
    take_command(box, 2000, 0.0)
    box.live(1.0)
    box.write("holding", 0, [3000], 1.1)
    assert box.output == SAFE
    assert box.read("coil", 0, 1, 1.2) == [0]
    box.write("coil", 0, [1], 1.3)
    assert box.output == 3.0


def test_its_own_controller_starts_without_a_bump_and_reaches_the_set_point() -> None:
    box = device()
    take_command(box, 500, 0.0)
    box.write("holding", 1, [1], 0.1)
    box.write("holding", 2, [300], 0.1)
    box.write("coil", 1, [1], 0.1)
    before = box.output
    box.write("coil", 0, [0], 0.1)
    assert box.output == before
    box.live(10.0)
    assert box.plant.y_true == pytest.approx(0.3, abs=1e-3)
    box.write("coil", 1, [0], 10.0)
    assert box.output == SAFE


def test_its_pi_is_the_textbook_law_sampled_every_10_ms() -> None:
    K, Ti = 2.0, 0.5
    box = device(gains=(K, Ti))
    box.write("holding", 2, [100], 0.0)
    box.write("coil", 1, [1], 0.0)
    twin = Servo(ServoSettings(noise=0.0, resolution=0.0))
    u, before = 0.0, 0.1 - twin.measure()
    for k in range(1, 51):
        twin.advance(u, 0.01)
        error = 0.1 - twin.measure()
        u += K * (error - before) + K * 0.01 / Ti * error
        before = error
        box.live(0.01 * k + 1e-6)
        assert box.output == pytest.approx(u, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(("table", "address", "count"), [("input", 3, 1), ("holding", 3, 1), ("coil", 2, 1)])
def test_a_register_that_is_not_there_is_refused(table: Table, address: int, count: int) -> None:
    with pytest.raises(IllegalAddress):
        device().read(table, address, count, 0.0)


def test_half_a_float_is_refused() -> None:
    box = device()
    with pytest.raises(IllegalAddress, match="half a value"):
        box.write("holding", 10, [0x4000], 0.0)
    assert box.value["K"] == 2.0


@given(cuts=st.lists(st.floats(0.0, 3.0), max_size=10))
def test_when_it_is_looked_at_changes_nothing(cuts: list[float]) -> None:
    looked, left_alone = device(), device()
    for box in (looked, left_alone):
        take_command(box, 700, 0.0)
    for now_s in sorted(cuts):
        looked.live(now_s)
    for box in (looked, left_alone):
        box.live(3.0)
    assert looked.plant.y_true == pytest.approx(left_alone.plant.y_true, rel=1e-12, abs=1e-12)
    assert [change.t_s for change in looked.history] == [change.t_s for change in left_alone.history]
