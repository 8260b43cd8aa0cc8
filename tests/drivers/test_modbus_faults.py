"""What lines do to Modbus: late, lost, doubled, reordered and garbled answers; none of them becomes a sample."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from autotune.config.registers import RegisterMap
from autotune.errors import InputError, LinkError
from autotune.experiment.rig import Rig
from drivers import open_rig
from drivers.modbus import DeviceRefused, ModbusLink
from sim.modbus_rig import ModbusRig, RtuTransport, TcpTransport
from sim.plant import Plant
from sim.serial_line import SerialLine
from tests.drivers.bench import (
    LIMIT_S,
    REGISTERS,
    U_SAFE,
    register_device,
    rig_of,
    rtu_bench,
    rtu_settings,
    servo,
    tcp_bench,
    tcp_settings,
    tls_settings,
)
from tests.drivers.tcp_relay import TcpRelay

#: nothing in it identifies an answer: one measurement, one command
BARE = RegisterMap.model_validate({"y": {"table": "input", "address": 0, "type": "float32"}, "u": {"address": 0}})

Fate = Sequence[tuple[float, bytes]]


class Counter:
    """A plant whose n-th measurement is n, so that a sample says which request it answers."""

    def __init__(self) -> None:
        self._servo: Plant = servo()
        self.measured = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._servo, name)

    def measure(self) -> float:
        self.measured += 1
        return float(self.measured)


@contextmanager
def counting_rtu(
    tamper: Callable[[bytes, str], Fate], registers: RegisterMap, *, timeout_s: float = 0.04
) -> Iterator[tuple[Rig, Counter]]:
    plant = Counter()
    device = register_device(registers, plant)
    with SerialLine(tamper) as line, ModbusRig(device, RtuTransport(device=line.rig_device, parity="N")):
        rig = rig_of(rtu_settings(line.host_device, registers, timeout_s=timeout_s, late_reply_s=0.6, retries=2))
        yield rig, plant
        rig.close()


class Cable:
    """Delays every fifth answer or so beyond the time-out, and loses, flips and doubles others."""

    def __init__(self, seed: int, *, refuses: bool) -> None:
        self._random = random.Random(seed)
        self._refuses = refuses
        self.samples_asked = 0
        self.harmed = 0

    def __call__(self, frame: bytes, direction: str) -> Fate:
        if direction == "to device":
            if frame[1] == 4:
                self.samples_asked += 1
            if frame[1] == 2 and not self._refuses:
                return ()  # a device without discrete inputs that keeps silent about it
            return ((0.0, frame),)
        draw = self._random.random()
        self.harmed += draw < 0.3
        if draw < 0.2:
            return ((self._random.uniform(0.05, 0.15), frame),)
        if draw < 0.25:
            return ()
        if draw < 0.3:
            at, bit = self._random.randrange(len(frame)), 1 << self._random.randrange(8)
            return ((0.0, frame[:at] + bytes((frame[at] ^ bit,)) + frame[at + 1 :]),)
        return ((0.0, frame),)


@pytest.mark.parametrize("refuses", [True, False], ids=["device refuses", "device keeps silent"])
@pytest.mark.parametrize("registers", [BARE, REGISTERS], ids=["bare", "with heartbeat echo"])
def test_a_late_answer_on_a_serial_line_never_becomes_a_sample(registers: RegisterMap, refuses: bool) -> None:
    cable = Cable(seed=3, refuses=refuses)
    with counting_rtu(cable, registers) as (rig, plant):
        good = 0
        while cable.harmed < (24 if refuses else 9):
            try:
                if not good:
                    rig.open()
                reading = rig.read()
                # every request that reached the device was measured once, and the line keeps the order: the sample of
                # the last request is the only one that equals their number
                assert reading.y == cable.samples_asked == plant.measured
                good += 1
                rig.write(0.25)
            except LinkError:
                continue  # given up after its attempts: no sample at all
        assert good >= 3


def test_without_the_flush_a_late_answer_would_be_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    # the control to the test above: it is the flush that keeps the late answer out, nothing else
    monkeypatch.setattr(ModbusLink, "_flush", ModbusLink.connect)
    state = {"late": 0, "asked": 0}

    def once_late(frame: bytes, direction: str) -> Fate:
        if direction == "to device":
            state["asked"] += 1
        elif state["late"]:
            state["late"] -= 1
            return ((0.35, frame),)
        return ((0.0, frame),)

    with counting_rtu(once_late, BARE, timeout_s=0.2) as (rig, plant):
        rig.open()
        state.update(late=1, asked=0)
        before = plant.measured
        assert rig.read().y == before + 1
        assert state["asked"] == 2  # the retry was asked, yet the first request's answer was taken


def test_an_interrupted_request_leaves_no_answer_for_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = {"on": False}

    def delayed(frame: bytes, direction: str) -> Fate:
        return ((0.15 if slow["on"] and direction == "to host" else 0.0, frame),)

    plant = Counter()
    device = register_device(BARE, plant)
    with SerialLine(delayed) as line, ModbusRig(device, RtuTransport(device=line.rig_device, parity="N")):
        rig = rig_of(rtu_settings(line.host_device, BARE, timeout_s=1.0))
        rig.open()
        slow["on"] = True
        client: Any = rig._link._client  # type: ignore[attr-defined]  # where a Ctrl-C would strike
        receive = client.recv

        def interrupted(size: int | None) -> bytes:
            client.recv = receive
            raise KeyboardInterrupt

        client.recv = interrupted
        with pytest.raises(KeyboardInterrupt):
            rig.read()
        slow["on"] = False
        assert rig.read().y == plant.measured
        rig.close()


@contextmanager
def relayed(tamper: Callable[[bytes, str], Fate], **changes: Any) -> Iterator[tuple[Rig, Counter, TcpRelay]]:
    plant = Counter()
    device = register_device(BARE, plant)
    with ModbusRig(device, TcpTransport()) as server, TcpRelay(server.port) as relay:
        rig = rig_of(tcp_settings(relay.port, BARE, **changes))
        rig.open()
        rig.read()
        relay.tamper = tamper
        yield rig, plant, relay
        rig.close()


def _doubled(frame: bytes, direction: str) -> Fate:
    return ((0.0, frame), (0.0, frame)) if direction == "to host" else ((0.0, frame),)


def _sliced(frame: bytes, direction: str) -> Fate:
    return [(0.002 * k, frame[k : k + 1]) for k in range(len(frame))]


@pytest.mark.parametrize("harm", [_doubled, _sliced], ids=["doubled", "sliced"])
def test_doubled_and_sliced_tcp_answers_are_read_as_one(harm: Callable[[bytes, str], Fate]) -> None:
    with relayed(harm, timeout_s=2.0) as (rig, plant, _):
        for _k in range(20):
            reading = rig.read()
            assert reading.y == plant.measured
            assert not reading.suspect


def test_a_retried_tcp_sample_is_suspect_and_is_the_retrys_own() -> None:
    late = {"left": 0}

    def sometimes_late(frame: bytes, direction: str) -> Fate:
        if direction == "to host" and late["left"]:
            late["left"] -= 1
            return ((0.3, frame),)
        return ((0.0, frame),)

    with relayed(sometimes_late, timeout_s=0.2, retries=2) as (rig, plant, _):
        late["left"] = 1
        reading = rig.read()
        assert reading.suspect
        assert reading.y == plant.measured
        for _k in range(5):
            again = rig.read()
            assert again.y == plant.measured
            assert not again.suspect


def test_an_answer_to_an_older_request_is_not_taken() -> None:
    kept: list[bytes] = []

    def stale_first(frame: bytes, direction: str) -> Fate:
        if direction == "to device":
            return ((0.0, frame),)
        kept.append(frame)
        return [(0.0, old) for old in kept[-2:]]

    with relayed(stale_first, timeout_s=2.0) as (rig, plant, _):
        for _k in range(10):
            assert rig.read().y == plant.measured


def test_a_half_open_connection_ends_in_an_error_within_its_time_outs() -> None:
    with relayed(lambda frame, direction: (), timeout_s=0.1, retries=1) as (rig, _, relay):
        start_s = rig.clock.now()
        with pytest.raises(LinkError, match="no answer"):
            rig.read()
        assert rig.clock.now() - start_s >= 0.2
        relay.tamper = lambda frame, direction: ((0.0, frame),)
        assert not rig.read().suspect


def test_a_reset_connection_is_made_anew_and_the_sample_marked() -> None:
    with relayed(lambda frame, direction: ((0.0, frame),), timeout_s=2.0) as (rig, plant, relay):
        relay.reset()
        reading = rig.read()
        assert reading.suspect
        assert reading.y == plant.measured


@pytest.mark.parametrize("harm", ["length", "protocol", "function", "count"])
def test_a_frame_that_is_no_answer_to_the_request_is_refused(harm: str) -> None:
    def garbled(frame: bytes, direction: str) -> Fate:
        if direction == "to device":
            return ((0.0, frame),)
        match harm:
            case "length":
                return ((0.0, frame[:4] + b"\x00\x40" + frame[6:]),)
            case "protocol":
                return ((0.0, frame[:2] + b"\x00\x01" + frame[4:]),)
            case "function":
                return ((0.0, frame[:7] + bytes((3,)) + frame[8:]),)
            case _:
                return ((0.0, frame[:4] + b"\x00\x05" + frame[6:8] + b"\x02" + frame[9:11]),)

    with relayed(garbled, timeout_s=0.15) as (rig, _, _relay), pytest.raises(LinkError):
        rig.read()


@pytest.mark.parametrize(
    ("code", "says"),
    [(1, "function"), (2, "address"), (3, "value"), (4, "failed"), (6, "busy"), (10, "gateway"), (11, "gateway")],
)
def test_a_modbus_exception_is_named_with_its_register(code: int, says: str) -> None:
    refusing = {"code": None}

    def refuse(table: str, address: int, writes: bool) -> int | None:
        return refusing["code"] if table == "input" else None

    with tcp_bench(refuse=refuse) as bench:
        bench.rig.open()
        refusing["code"] = code  # type: ignore[assignment]  # None until now
        with pytest.raises(LinkError, match=rf"input 0.*{says}"):
            bench.rig.read()


@pytest.mark.parametrize("code", [5, 6])
def test_a_device_that_is_busy_for_a_third_of_a_second_is_waited_for(code: int) -> None:
    """Two attempts at once used to be all it got; the waits together are no longer than for a silent one."""
    busy = {"until_s": 0.0}

    def refuse(table: str, address: int, writes: bool) -> int | None:
        return code if time.monotonic() < busy["until_s"] else None

    with tcp_bench(refuse=refuse, timeout_s=1.0) as bench:
        assert bench.device is not None
        bench.device.deadman_s = LIMIT_S  # what it does meanwhile is not asked here
        bench.rig.open()
        busy["until_s"] = time.monotonic() + 0.35
        assert bench.rig.read().suspect
        busy["until_s"] = time.monotonic() + 0.35
        bench.rig.write(0.5)
        assert bench.output() == pytest.approx(0.5)


def test_the_safe_output_is_written_again_until_a_busy_device_takes_it() -> None:
    busy = {"until_s": 0.0}

    def refuse(table: str, address: int, writes: bool) -> int | None:
        return 6 if writes and time.monotonic() < busy["until_s"] else None

    with tcp_bench(refuse=refuse, timeout_s=0.1, retries=0) as bench:
        bench.rig.open()
        bench.rig.write(0.5)
        busy["until_s"] = time.monotonic() + 0.8  # longer than one request waits
        bench.rig.make_safe()
        assert time.monotonic() > busy["until_s"]
        assert bench.output() == U_SAFE


def test_a_busy_device_is_asked_again_and_the_sample_marked() -> None:
    busy = {"left": 0}

    def refuse(table: str, address: int, writes: bool) -> int | None:
        busy["left"] -= 1
        return 6 if busy["left"] >= 0 else None

    with tcp_bench(refuse=refuse) as bench:
        bench.rig.open()
        busy["left"] = 1
        assert bench.rig.read().suspect
        assert not bench.rig.read().suspect


def test_a_wrong_unit_id_is_an_error_with_the_way_out() -> None:
    with tcp_bench(unit_id=7) as bench, pytest.raises(LinkError, match=r"unit 7.*unit_id"):
        bench.rig.open()
    silent = rtu_bench(unit_id=7, timeout_s=0.1, late_reply_s=0.1)
    with silent as bench, pytest.raises(LinkError, match=r"unit 7.*unit_id"):
        bench.rig.open()


def test_a_range_of_commands_that_the_register_cannot_hold_is_refused_before_anything_is_sent() -> None:
    narrow = REGISTERS.model_copy(update={"u": REGISTERS.u.model_copy(update={"scale": 1e-4})})
    with pytest.raises(InputError, match=r"u: -10 does not fit the register \(int16, scale 0.0001"):
        rig_of(tcp_settings(1, narrow))


def test_a_device_that_starts_anew_is_noticed_by_its_heartbeat() -> None:
    with tcp_bench(feed_s=60.0) as bench:  # a busy computer must not write the next beat in between
        bench.rig.open()
        bench.rig.write(0.5)
        assert bench.device is not None
        bench.device._values["heartbeat"] = 0.0  # what a reset leaves
        with pytest.raises(LinkError, match=r"echoes heartbeat 0.*restarted, another master"):
            bench.rig.read()


def test_gains_that_are_not_taken_leave_the_old_ones() -> None:
    from autotune.controller import PIDController

    broken = {"on": False}

    apart = REGISTERS.model_copy(update={"Ti": REGISTERS.Ti.model_copy(update={"address": 14})})  # type: ignore[union-attr]
    device = register_device(apart)

    def refuse(table: str, address: int, writes: bool) -> int | None:
        if broken["on"] and writes and address == 14:
            broken["on"] = False  # once: the way back is open
            return 4
        return None

    with ModbusRig(device, TcpTransport(), refuse=refuse) as server:
        rig: Any = rig_of(tcp_settings(server.port, apart))
        rig.open()
        before = rig.read_gains()
        broken["on"] = True
        with pytest.raises(LinkError, match=r"not taken .*; the device holds its old gains again"):
            rig.write_gains(PIDController(K=9.0, Ti_s=9.0))
        assert rig.read_gains() == before
        with pytest.raises(InputError, match="map the register of Td_s"):
            rig.write_gains(PIDController(K=1.0, Ti_s=1.0, Td_s=0.1, Tf_s=0.01))
        with pytest.raises(InputError, match="Ti"):
            rig.write_gains(PIDController(K=1.0, Ti_s=1e9))
        assert rig.read_gains() == before
        rig.close()


def test_a_device_with_another_authoritys_certificate_or_name_is_refused(certificates: Path, tmp_path: Path) -> None:
    from tests.drivers.bench import certificates_by_the_book

    other = certificates_by_the_book(tmp_path)
    device = register_device()
    transport = TcpTransport(
        ca_file=str(certificates / "ca.pem"),
        cert_file=str(certificates / "rig.pem"),
        key_file=str(certificates / "rig.key"),
    )
    with ModbusRig(device, transport) as server:
        # (what the host trusts and shows, how the device is called) -> what is said
        wrong_name = rig_of(tls_settings(server.port, certificates, server_name="somebody-else"))
        with pytest.raises(LinkError, match="certificate verify failed"):
            wrong_name.open()
        not_trusted = rig_of(tls_settings(server.port, certificates, ca_file=str(other / "ca.pem")))
        with pytest.raises(LinkError, match="certificate verify failed"):
            not_trusted.open()
        stranger = rig_of(
            tls_settings(server.port, certificates, cert_file=str(other / "host.pem"), key_file=str(other / "host.key"))
        )
        with pytest.raises(LinkError):
            stranger.open()
        stranger.close()
        with pytest.raises(InputError, match=r"none\.key: no such file"):
            open_rig(
                tls_settings(server.port, certificates, key_file=str(tmp_path / "none.key")),
                u_range=(0.0, 1.0),
                u_safe=0.0,
            )
        assert device.output == pytest.approx(0.1)  # nobody has moved anything


def test_a_device_may_take_its_time_to_open_a_tls_session(certificates: Path) -> None:
    """A small one signs for a second; ``timeout_s`` is the wait for an answer, not for that."""
    sent: list[float] = []

    def slow_to_sign(record: bytes, direction: str) -> Fate:
        now = time.monotonic()
        if direction == "to device":
            return [(0.0, record)]
        sent.append(now)
        # what it says in its first half second comes at its end, in this order
        return [(max(sent[0] + 0.5 + 1e-4 * len(sent) - now, 0.0), record)]

    def record_length(head: bytes) -> int:
        return 5 + int.from_bytes(head[3:5], "big")

    transport = TcpTransport(
        ca_file=str(certificates / "ca.pem"),
        cert_file=str(certificates / "rig.pem"),
        key_file=str(certificates / "rig.key"),
    )
    with (
        ModbusRig(register_device(), transport) as server,
        TcpRelay(server.port, slow_to_sign, record_length) as line,
    ):
        rig = rig_of(tls_settings(line.port, certificates, timeout_s=0.2))
        rig.open()
        assert time.monotonic() - sent[0] > 0.5
        assert math.isfinite(rig.read().y)
        rig.close()


def test_make_safe_reconnects_where_the_link_came_back() -> None:
    with relayed(lambda frame, direction: (), timeout_s=0.05) as (rig, _, relay):
        with pytest.raises(LinkError):
            rig.write(0.5)
        relay.tamper = lambda frame, direction: ((0.0, frame),)
        relay.reset()
        rig.make_safe()
        # BARE's command is in whole volts: -0.5 is rounded to even
        assert rig.read().y > 0
    assert U_SAFE == -0.5


def test_refusals_are_a_verdict_of_their_own() -> None:
    assert issubclass(DeviceRefused, LinkError)
