"""What every rig keeps to, whatever it is reached by: the same statements in process, replayed, on any line."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest

from autotune.controller import PIDController
from autotune.errors import LinkError
from autotune.experiment.leaving import leave
from autotune.experiment.rig import Former, HandsBack, HoldsGains
from sim.serial_rig import SerialRig
from tests.drivers.bench import (
    DEADMAN_S,
    LIMIT_S,
    U_SAFE,
    Bench,
    firmware_bench,
    opcua_bench,
    replay_bench,
    rtu_bench,
    s7_bench,
    serial_bench,
    simulated_bench,
    tcp_bench,
    tls_bench,
)
from tests.drivers.test_rig_commands import free_port

FIRMWARE = pytest.param(
    "firmware", marks=pytest.mark.system("gcc", "gcc-avr", "avr-libc", "libsimavr-dev", "libelf-dev")
)
ON_DEVICE = pytest.param("firmware, laws on the device", marks=FIRMWARE.marks)
ALL = ("simulated", "replay", "tcp", "rtu", "tls", "opcua", "s7", "serial", FIRMWARE, ON_DEVICE)
MOVING = ("simulated", "tcp", "rtu", "tls", "opcua", "s7", "serial", FIRMWARE, ON_DEVICE)
REAL = ("tcp", "rtu", "tls", "opcua", "s7", "serial")


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    match request.param:
        case "simulated":
            context = simulated_bench()
        case "replay":
            context = replay_bench()
        case "tcp":
            context = tcp_bench()
        case "rtu":
            context = rtu_bench()
        case "opcua":
            context = opcua_bench(f"opc.tcp://127.0.0.1:{free_port()}")
        case "s7":
            context = s7_bench(free_port())
        case "serial":
            context = serial_bench()
        case "firmware":
            context = firmware_bench(request.getfixturevalue("uno_elf"))
        case "firmware, laws on the device":
            context = firmware_bench(request.getfixturevalue("uno_elf"), relay="device")
        case _:
            certificates: Path = request.getfixturevalue("certificates")
            context = tls_bench(certificates)
    with context as made:
        yield made


@pytest.mark.parametrize("bench", ALL, indirect=True)
def test_samples_are_finite_and_stamped_on_the_rigs_own_clock(bench: Bench) -> None:
    rig = bench.rig
    rig.open()
    stamps = []
    for k, u in enumerate(bench.commands):
        rig.clock.sleep_until(0.01 * k)
        before = rig.clock.now()
        reading = rig.read()
        assert math.isfinite(reading.y)
        assert not reading.suspect
        assert reading.t_s >= before or reading.t_s == pytest.approx(before)
        assert reading.t_s <= rig.clock.now()
        assert reading.latency_s >= 0.0
        stamps.append(reading.t_s)
        rig.write(u)
    assert stamps == sorted(set(stamps))


@pytest.mark.parametrize("bench", ALL, indirect=True)
def test_a_deadline_is_never_met_early_and_a_passed_one_does_not_wait(bench: Bench) -> None:
    clock = bench.rig.clock
    bench.rig.open()
    deadline = clock.now() + 0.02
    clock.sleep_until(deadline)
    met = clock.now()
    assert met >= deadline
    clock.sleep_until(deadline - 10.0)
    assert clock.now() >= met


@pytest.mark.parametrize("bench", MOVING, indirect=True)
def test_a_command_is_what_the_actuator_gets_and_what_is_read_back(bench: Bench) -> None:
    bench.rig.open()
    for u in bench.commands:
        bench.rig.write(u)
        assert bench.output() == pytest.approx(u, abs=1e-9)
        bench.rig.clock.sleep_until(bench.rig.clock.now() + 0.002)
        assert bench.rig.read().u_applied == pytest.approx(u, abs=1e-9)


@pytest.mark.parametrize("bench", MOVING, indirect=True)
def test_the_safe_output_is_reached_however_often_it_is_asked_for(bench: Bench) -> None:
    bench.rig.open()
    bench.rig.write(0.5)
    bench.rig.make_safe()
    assert bench.output() == pytest.approx(U_SAFE, abs=1e-9)
    bench.rig.make_safe()
    assert bench.output() == pytest.approx(U_SAFE, abs=1e-9)
    bench.rig.close()
    bench.rig.make_safe()
    assert bench.output() == pytest.approx(U_SAFE, abs=1e-9)


@pytest.mark.parametrize("bench", ALL, indirect=True)
def test_safe_and_close_can_be_called_in_any_state(bench: Bench) -> None:
    bench.rig.make_safe()
    bench.rig.close()
    bench.rig.close()
    bench.rig.open()
    bench.rig.close()
    bench.rig.make_safe()
    bench.rig.close()
    with pytest.raises(LinkError):
        bench.rig.read()
    with pytest.raises(LinkError):
        bench.rig.write(bench.commands[0])


@pytest.mark.parametrize("bench", ALL, indirect=True)
def test_a_closed_rig_can_be_opened_again(bench: Bench) -> None:
    for _ in range(2):
        bench.rig.open()
        assert math.isfinite(bench.rig.read().y)
        bench.rig.write(bench.commands[0])
        bench.rig.make_safe()
        bench.rig.close()


@pytest.mark.parametrize("bench", ALL, indirect=True)
def test_a_cut_link_is_an_error_and_never_a_sample(bench: Bench) -> None:
    bench.rig.open()
    bench.rig.read()
    bench.cut()
    for _ in range(2):
        with pytest.raises(LinkError) as caught:
            bench.rig.read()
        assert str(caught.value).count("\n") == 0
        assert caught.value.remedy


@pytest.mark.parametrize("bench", MOVING, indirect=True)
def test_gains_are_handed_over_and_read_back(bench: Bench) -> None:
    bench.rig.open()
    assert isinstance(bench.rig, HoldsGains)
    wanted = PIDController(K=-0.025053, Ti_s=3.5915)
    bench.rig.write_gains(wanted)
    held = bench.rig.read_gains()
    assert held.kind == "pi"
    assert pytest.approx(wanted.K, rel=1e-6) == held.K  # a float32
    assert held.Ti_s == pytest.approx(wanted.Ti_s, abs=1e-3)  # counts of a millisecond


@pytest.mark.parametrize("bench", REAL, indirect=True)
def test_a_silent_host_leaves_the_safe_output_within_the_dead_man_time(bench: Bench) -> None:
    bench.rig.open()
    bench.watch()
    bench.rig.write(0.5)
    assert bench.device is not None
    last_command_s = bench.device.history[-1].t_s
    assert bench.released.wait(LIMIT_S)
    final = bench.device.history[-1]
    assert final.cause == "dead-man"
    assert final.output == pytest.approx(U_SAFE)
    # enabling counts as a sign of life too, hence the later of the two
    assert final.t_s - last_command_s == pytest.approx(DEADMAN_S, abs=1e-6)
    with pytest.raises(LinkError, match="took the actuator back"):
        bench.rig.read()
    with pytest.raises(LinkError, match="not in command"):
        bench.rig.write(0.5)


@pytest.mark.parametrize("bench", REAL, indirect=True)
def test_the_host_takes_over_without_a_bump(bench: Bench) -> None:
    assert bench.device is not None
    came_with = bench.device.output  # the servo holds its load
    bench.rig.open()
    assert bench.device.output == pytest.approx(came_with, abs=1e-3)
    assert bench.device.value["safe"] == pytest.approx(U_SAFE)


def _reads_on(bench: Bench) -> tuple[float, float]:
    """Read for longer than the dead-man time; return the longest wait between two requests [s] and the last output."""
    rig = bench.rig
    rig.open()
    asked_s = rig.clock.now()
    end_s, longest_s, output = asked_s + 1.5 * DEADMAN_S, 0.0, math.nan
    try:
        rig.write(0.25)
        while asked_s < end_s:
            rig.clock.sleep_until(asked_s + 0.02)
            before_s = rig.clock.now()
            rig.read()
            output = bench.output()
            longest_s, asked_s = max(longest_s, rig.clock.now() - asked_s), before_s
    except LinkError:
        longest_s, output = max(longest_s, rig.clock.now() - asked_s), math.nan
    rig.close()
    return longest_s, output


@pytest.mark.parametrize("bench", REAL, indirect=True)
def test_reading_alone_keeps_the_host_in_command(bench: Bench) -> None:
    longest_s = DEADMAN_S
    while longest_s >= DEADMAN_S:  # where a busy computer holds the host up for so long, the dead-man is right
        longest_s, output = _reads_on(bench)
    assert output == pytest.approx(0.25)


@pytest.mark.parametrize("bench", REAL, indirect=True)
def test_the_devices_own_controller_takes_over_and_holds_the_set_point(bench: Bench) -> None:
    rig, device = bench.rig, bench.device
    assert device is not None
    rig.open()
    rig.write_gains(PIDController(K=2.0, Ti_s=1.0))  # type: ignore[attr-defined]  # HoldsGains
    rig.start_controller(0.2)  # type: ignore[attr-defined]  # a register rig's own
    assert not device.value["enable"]
    start_s = rig.clock.now()
    rig.clock.sleep_until(start_s + 1.5)
    assert rig.read().y == pytest.approx(0.2, abs=0.05)
    assert {change.cause for change in list(device.history)[-10:]} == {"controller"}
    rig.make_safe()
    assert device.output == pytest.approx(U_SAFE)


@pytest.mark.parametrize("bench", ["serial", FIRMWARE, ON_DEVICE], indirect=True)
def test_the_devices_own_controller_gets_the_actuator_back_at_its_set_point(bench: Bench) -> None:
    rig = bench.rig
    rig.open()
    assert isinstance(rig, HandsBack)
    assert rig.former is None
    rig.write_gains(PIDController(K=0.5, Ti_s=1.0))  # type: ignore[attr-defined]  # HoldsGains
    rig.start_controller(0.2)  # type: ignore[attr-defined]  # of these
    rig.close()
    rig.open()
    assert rig.former is not None
    assert rig.former.setpoint == pytest.approx(0.2, abs=1e-6)
    rig.write(-0.25)
    farewell = leave(rig, None)
    assert farewell.output == "handed back to its own controller: automatic at set-point 0.2"
    rig.open()  # it runs as before the session
    assert rig.former == Former(setpoint=pytest.approx(0.2, abs=1e-6))
    rig.make_safe()
    assert bench.output() == pytest.approx(U_SAFE)


def test_a_controller_whose_set_point_is_not_said_is_left_to_a_person(monkeypatch: pytest.MonkeyPatch) -> None:
    with serial_bench() as bench:
        rig = bench.rig
        rig.open()
        rig.start_controller(0.2)  # type: ignore[attr-defined]  # of this one
        rig.close()
        known = SerialRig._obey
        monkeypatch.setattr(  # firmware before version 3
            SerialRig, "_obey", lambda self, kind, payload: 1 if kind == 0x0B else known(self, kind, payload)
        )
        rig.open()
        assert isinstance(rig, HandsBack)
        assert str(rig.former) == "automatic"
        farewell = leave(rig, None)
        assert farewell.output == "safe output"
        assert "was not restored: give it the actuator back at the rig" in farewell.note
