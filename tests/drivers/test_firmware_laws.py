"""The firmware's portable part, compiled for this computer: the laws are those in Python; its frames, its modes."""

from __future__ import annotations

import ctypes
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.design.law import PILaw
from autotune.experiment.relay import RelaySettings
from drivers.line_protocol import PAYLOAD, Decoder, Frame, Kind, encode
from tests.drivers.firmware_build import PortableFirmware
from tests.drivers.laws import LAWS, RELAYS, longest_pending, measurements, pi_outputs, relay_outputs

pytestmark = pytest.mark.system("gcc")
PENDING_MAX = 8


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> PortableFirmware:
    return PortableFirmware(tmp_path_factory.mktemp("double"), "double")


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> PortableFirmware:
    return PortableFirmware(tmp_path_factory.mktemp("float"), "float")


@pytest.mark.parametrize("settings", RELAYS, ids=str)
def test_the_relay_in_c_is_the_relay_in_python(
    exact: PortableFirmware, single: PortableFirmware, settings: RelaySettings
) -> None:
    compared = 0
    for seed in range(4):
        y = measurements(seed)
        if longest_pending(settings, y) > PENDING_MAX:
            continue
        u = relay_outputs(settings, y)
        assert np.ptp(u) == 2 * settings.amplitude  # it did switch
        np.testing.assert_array_equal(exact.relay_outputs(settings, y), u)
        np.testing.assert_array_equal(single.relay_outputs(settings, y), u)
        compared += 1
    assert compared > 0


@given(
    delay=st.floats(0.0, 100.0),
    hysteresis=st.floats(0.0, 60.0),
    smoothing=st.integers(1, 32),
    seed=st.integers(0, 10_000),
)
def test_any_delay_and_hysteresis_switch_alike(
    exact: PortableFirmware, delay: float, hysteresis: float, smoothing: int, seed: int
) -> None:
    settings = replace(RELAYS[0], delay_samples=delay, hysteresis=hysteresis, smoothing=smoothing)
    y = measurements(seed, 600)
    u, there = exact.relay_outputs(settings, y), relay_outputs(settings, y)
    if longest_pending(settings, y) <= PENDING_MAX:
        assert len(u) == len(y)
    np.testing.assert_allclose(u, there[: len(u)], rtol=0.0, atol=1e-9 * settings.amplitude)


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_the_pi_in_c_is_the_pi_in_python(exact: PortableFirmware, single: PortableFirmware, law: PILaw) -> None:
    y = measurements(1)
    u = pi_outputs(law, y, 500.0, 7777.0)
    np.testing.assert_allclose(exact.pi_outputs(law, y, 500.0, 7777.0), u, rtol=1e-12)
    # single precision: the integral keeps 24 bits of up to 16000 counts, a thousandth of a count per step
    np.testing.assert_allclose(single.pi_outputs(law, y, 500.0, 7777.0), u, atol=2.0)


def test_relay_settings_that_make_no_sense_are_refused(exact: PortableFirmware) -> None:
    good = [512.0, 8000.0, 512.0, 1.0, 5.0]
    y, u = np.zeros(1), np.zeros(1)
    run = exact.library.relay_run
    point = ctypes.c_void_p

    def accepted(numbers: list[float], smoothing: int = 1, sign: int = 1) -> bool:
        values = np.array(numbers)
        return bool(run(point(values.ctypes.data), smoothing, sign, point(y.ctypes.data), point(u.ctypes.data), 1) == 1)

    assert accepted(good)
    assert not accepted(good, smoothing=0)
    assert not accepted(good, smoothing=33)
    assert not accepted(good, sign=0)
    for at in range(5):
        assert not accepted([*good[:at], float("nan"), *good[at + 1 :]])
    for at in (2, 3, 4):
        assert not accepted([*good[:at], -1.0, *good[at + 1 :]])


class Device:
    """The firmware's device, ticked by hand."""

    def __init__(self, firmware: PortableFirmware) -> None:
        self._library = firmware.library
        self._it = ctypes.c_void_p(self._library.device_new())
        self._ticks = 0
        self._y = 500
        self._sequence = 0

    def ask(self, kind: Kind, *values: float) -> Frame:
        """Send a request through the firmware's own receiver and return its answer."""
        self._sequence += 1
        receiver = ctypes.create_string_buffer(80)
        answer, wire = ctypes.create_string_buffer(62), ctypes.create_string_buffer(64)
        length = 0
        for byte in encode(Frame(kind=kind, sequence=self._sequence, values=values)):
            length = self._library.frame_receive(receiver, byte)
        assert length == 4 + PAYLOAD[kind].size
        size = self._library.device_request(self._it, receiver, length, answer)
        if size == 0:  # an EXCHANGE is answered with the tick from which its output acts
            self.tick(self._y)
            frame = self.report()
            assert frame is not None
        else:
            size = self._library.frame_close(answer, size, wire)
            (frame,) = Decoder().feed(wire.raw[:size])
        assert frame.sequence == self._sequence
        return frame

    def tick(self, y: int) -> int:
        """Let a tick pass; return the output."""
        self._ticks += 1
        self._y = y
        acting = self._library.device_output(self._it)
        return int(self._library.device_tick(self._it, 1000 * self._ticks, y, acting))

    def report(self) -> Frame | None:
        """Return the answer or the row that is due."""
        content, wire = ctypes.create_string_buffer(62), ctypes.create_string_buffer(64)
        size = self._library.device_report(self._it, content)
        if size == 0:
            return None
        size = self._library.frame_close(content, size, wire)
        return Decoder().feed(wire.raw[:size])[0]


@pytest.fixture
def device(single: PortableFirmware) -> Device:
    return Device(single)


RELAY = (512.0, 8000.0, 500.0, 4.0, 12.0, 4, -1, 10, 1000, 100, 900)


def test_nobody_commands_until_a_host_takes_it(device: Device) -> None:
    assert device.ask(Kind.EXCHANGE, 100).values == (Kind.EXCHANGE, 3)
    assert device.ask(Kind.RELAY, *RELAY).values == (Kind.RELAY, 3)
    assert device.tick(500) == 0
    assert device.ask(Kind.TAKE, 40, 1000, 15000, 300).kind == Kind.SAMPLE
    assert device.tick(501) == 0  # the output stays until the first command
    sample = device.ask(Kind.EXCHANGE, 1000)
    assert sample.values == (3000, 501, 1000, 1, 1)  # the tick from which the command acts
    assert device.tick(502) == 1000
    assert device.ask(Kind.READ).values[2] == 1000


@pytest.mark.parametrize(("kind", "values"), [(Kind.EXCHANGE, (999,)), (Kind.EXCHANGE, (15001,))])
def test_a_command_beyond_the_limits_is_refused_and_changes_nothing(
    device: Device, kind: Kind, values: tuple[int, ...]
) -> None:
    device.ask(Kind.TAKE, 40, 1000, 15000, 300)
    device.ask(Kind.EXCHANGE, 2000)
    assert device.ask(kind, *values).values == (kind, 4)
    assert device.tick(500) == 2000


def test_silence_ends_at_the_safe_output_and_stays_there(device: Device) -> None:
    device.ask(Kind.TAKE, 40, 1000, 15000, 300)
    device.ask(Kind.EXCHANGE, 2000)
    outputs = [device.tick(500) for _ in range(400)]
    assert outputs[:299] == [2000] * 299  # one more has passed with the answer
    assert outputs[299:] == [40] * 101
    device.ask(Kind.READ)
    assert device.tick(500) == 40
    assert int(device.ask(Kind.READ).values[3]) == 4  # nobody commands, the dead-man ran out


def test_the_relay_on_the_device_is_the_law_and_ends_by_itself(device: Device) -> None:
    device.ask(Kind.TAKE, 40, 1000, 15000, 60_000)
    assert device.ask(Kind.RELAY, *RELAY).kind == Kind.SAMPLE
    settings = RelaySettings(
        y_centre=512.0, midpoint=8000.0, amplitude=500.0, hysteresis=4.0, delay_samples=12.0, smoothing=4, plant_sign=-1
    )
    y = measurements(3, 1100)
    wanted = np.round(relay_outputs(settings, y)[:1000])
    rows, outputs = [], []
    for value in y:
        outputs.append(device.tick(int(value)))
        row = device.report()
        rows += [row] if row else []
    np.testing.assert_array_equal(outputs[:1000], wanted)
    assert outputs[1000:] == [40] * 100
    assert [row.sequence for row in rows] == list(range(1, 102))
    # what acts from y's instant on is the output that was set a tick before
    acting = [0, *outputs]
    assert [row.values[2] for row in rows[:100]] == acting[9:1000:10]
    assert [row.values[5] for row in rows[:100]] == [sum(acting[: k + 1]) for k in range(9 - 1, 999, 10)]
    assert [row.values[1] for row in rows[:100]] == list(y[9:1000:10])
    assert int(rows[-1].values[3]) == 0x10  # the time is over


def test_a_limit_passed_on_the_device_is_the_safe_output_in_the_same_tick(device: Device) -> None:
    device.ask(Kind.TAKE, 40, 1000, 15000, 60_000)
    device.ask(Kind.RELAY, *RELAY)
    assert device.tick(600) in (7500, 8500)
    assert device.tick(901) == 40
    row = device.report()
    assert row is not None
    assert int(row.values[3]) == 0x08


@pytest.mark.parametrize("at", range(5))
def test_what_is_not_a_number_does_not_start_the_relay(device: Device, at: int) -> None:
    device.ask(Kind.TAKE, 40, 1000, 15000, 300)
    values = (*RELAY[:at], float("nan"), *RELAY[at + 1 :])
    assert device.ask(Kind.RELAY, *values).values == (Kind.RELAY, 4)
    assert int(device.ask(Kind.READ).values[3]) == 1


def test_levels_beyond_the_limits_do_not_start_the_relay(device: Device) -> None:
    device.ask(Kind.TAKE, 40, 7600, 15000, 300)
    assert device.ask(Kind.RELAY, *RELAY).values == (Kind.RELAY, 4)


def test_the_pi_takes_over_without_a_bump_and_outlives_a_silent_host(device: Device) -> None:
    device.ask(Kind.TAKE, 40, 1000, 15000, 300)
    device.ask(Kind.EXCHANGE, 6000)
    held = device.ask(Kind.SET_GAINS, -2.0, 0.5)
    assert held.values == (-2.0, 0.5)
    assert device.ask(Kind.GET_GAINS).values == (-2.0, 0.5)
    assert device.ask(Kind.SET_GAINS, float("nan"), 0.5).values == (Kind.SET_GAINS, 4)
    assert device.ask(Kind.GET_GAINS).values == (-2.0, 0.5)
    device.tick(500)
    device.ask(Kind.REGULATE, 500.0, 0, 0, 0, 0xFFFF)
    assert [device.tick(500) for _ in range(1000)] == [6000] * 1000
    assert device.tick(510) == 6020  # K (r - y) = 20
    assert device.ask(Kind.SAFE).kind == Kind.SAMPLE
    assert device.tick(510) == 40


def test_the_pi_on_trial_ends_with_its_host(device: Device) -> None:
    device.ask(Kind.TAKE, 40, 1000, 15000, 300)
    device.ask(Kind.EXCHANGE, 6000)
    device.tick(500)
    device.ask(Kind.TRY, -2.0, 0.5, 500.0, 0.0, 10, 60000, 0, 1023)
    outputs = [device.tick(500) for _ in range(400)]
    assert outputs == [6000] * 300 + [40] * 100
    assert device.ask(Kind.GET_LAW).values == (Kind.GET_LAW, 3)  # nobody regulates


def test_the_pi_says_how_it_runs_and_goes_on_so_after_a_host(device: Device) -> None:
    assert device.ask(Kind.GET_LAW).values == (Kind.GET_LAW, 3)
    device.ask(Kind.TAKE, 40, 1000, 15000, 300)
    device.ask(Kind.EXCHANGE, 6000)
    device.ask(Kind.SET_GAINS, -2.0, 0.5)
    device.ask(Kind.REGULATE, 512.5, 0, 0, 100, 900)
    law = device.ask(Kind.GET_LAW)
    assert law.kind == Kind.LAW
    assert law.values == (512.5, 0, 0, 100, 900, 40, 1000, 15000)
    before = device.tick(512)
    device.ask(Kind.TAKE, 0, 5000, 7000, 300)  # a host's session, which has limits of its own
    device.ask(Kind.TRY, -1.0, 1.0, 600.0, 0.0, 10, 1000, 0, 1023)
    assert device.ask(Kind.GET_LAW).values[:3] == (600.0, 10, 1000)
    setpoint, ticks_per_row, _, y_low, y_high, *output = law.values
    device.ask(Kind.TAKE, *output, 300)
    u = device.tick(512)
    device.ask(Kind.REGULATE, setpoint, ticks_per_row, 0, y_low, y_high)
    assert device.ask(Kind.GET_LAW).values == law.values
    assert abs(device.tick(512) - u) <= 1  # bumpless
    assert abs(u - before) <= 400
    assert [device.tick(512) for _ in range(400)][-1] != 40  # no dead-man ends it
    assert device.tick(901) == 40  # its own limit does


@given(st.binary(max_size=300), st.integers(0, 0xFFFF))
def test_noise_is_never_obeyed_and_what_follows_is(single: PortableFirmware, noise: bytes, sequence: int) -> None:
    receiver = ctypes.create_string_buffer(80)
    for byte in noise + b"\0":
        single.library.frame_receive(receiver, byte)
    wire = encode(Frame(kind=Kind.READ, sequence=sequence))
    assert [single.library.frame_receive(receiver, byte) for byte in wire] == [0] * (len(wire) - 1) + [4]
