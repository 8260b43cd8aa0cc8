"""Rigs behind a Siemens CPU: the ball and the servo on the server of python-snap7, and what goes wrong there."""

from __future__ import annotations

import re
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import tomli_w

from autotune.config import Config, load_config
from autotune.config.s7 import S7Settings
from autotune.controller import PIDController
from autotune.errors import AutotuneError, InputError, LinkError
from autotune.text_files import read_toml
from drivers import open_rig
from drivers.gain_rig import GainRegisterRig
from drivers.kinds import kind_of
from drivers.s7_rig import probe_kind
from tests.drivers.bench import PLACES, s7_bench, s7_settings
from tests.drivers.tcp_relay import TcpRelay, tpkt_length
from tests.drivers.test_rig_commands import free_port

if TYPE_CHECKING:
    from sim.s7_rig import S7Rig

pytest.importorskip("snap7", reason="needs the extra s7")

CONFIG = Path(__file__).parents[2] / "configs" / "ball_s7.toml"


def ball(folder: Path, **rig: Any) -> Config:
    """Return the shipped configuration on a free port, with changes to [rig]."""
    content = read_toml(CONFIG)
    content["rig"] |= {"port": free_port()} | rig
    path = folder / "ball.toml"
    path.write_text(tomli_w.dumps(content))
    return load_config(path)


def with_signals(config: Config, **changes: Any) -> Config:
    """Return the configuration with other places of signals."""
    assert isinstance(config.rig, S7Settings)
    signals = config.rig.signals.model_dump(exclude_none=True) | changes
    kept = {name: one for name, one in signals.items() if one is not None}
    rig = config.rig.model_copy(update={"signals": type(config.rig.signals).model_validate(kept)})
    return config.model_copy(update={"rig": rig})


def rig_of(config: Config, **changes: Any) -> GainRegisterRig:
    assert isinstance(config.rig, S7Settings)
    rig = open_rig(config.rig.model_copy(update=changes), u_range=(0.0, 10.0), u_safe=0.0)
    assert isinstance(rig, GainRegisterRig)
    return rig


@contextmanager
def served_ball(config: Config) -> Iterator[tuple[GainRegisterRig, S7Rig]]:
    """Serve the configuration's ball; yield the rig and the CPU."""
    from autotune.cli.served import serve_s7

    assert isinstance(config.rig, S7Settings)
    with serve_s7(config, config.rig) as server:
        rig = rig_of(config)
        try:
            yield rig, server
        finally:
            rig.close()


def refused(rig: GainRegisterRig) -> str:
    """Return the one line with which a session is refused."""
    with pytest.raises(AutotuneError) as error:
        rig.open()
    rig.close()
    assert "\n" not in str(error.value)
    return str(error.value)


def test_the_host_commands_and_leaves_the_rig_safe(tmp_path: Path) -> None:
    with served_ball(ball(tmp_path)) as (rig, server):
        rig.open()
        rig.write(4.0)
        rig.clock.sleep_until(rig.clock.now() + 0.05)
        reading = rig.read()
        assert reading.u_applied == 4.0
        assert 0.0 <= reading.y <= 10.0
        assert not reading.suspect
        first = reading.device_time_s
        rig.clock.sleep_until(rig.clock.now() + 0.2)
        assert 0.1 < rig.read().device_time_s - first < 1.0  # a TIME, in seconds
        rig.make_safe()
        assert server.device.output == 0.0


def test_bytes_lie_in_the_block_as_siemens_has_them(tmp_path: Path) -> None:
    with served_ball(ball(tmp_path)) as (rig, server):
        rig.open()
        rig.write(5.0)
        memory = bytes(server.cpu.block(10))
        assert memory[16:20] == bytes.fromhex("40A00000")
        assert memory[22:26] == bytes(4)
        rig.write_gains(PIDController(K=-0.25, Ti_s=6.0))
        assert struct.unpack(">2f", bytes(server.cpu.block(10))[36:44]) == (-0.25, 6.0)


def test_a_bit_is_written_and_its_neighbours_stay() -> None:
    with s7_bench(free_port()) as bench:
        rig: Any = bench.rig
        rig._link.connect()
        rig._put("automatic", 1.0)
        rig._put("enable", 1.0)
        assert rig._read(("enable", "automatic")) == {"enable": 1.0, "automatic": 1.0}
        rig._put("enable", 0.0)
        assert rig._read(("enable", "automatic")) == {"enable": 0.0, "automatic": 1.0}


def test_gains_of_pid_compact_are_written_and_read_back_in_its_form(tmp_path: Path) -> None:
    config = ball(tmp_path)
    assert config.controller is not None
    with served_ball(config) as (rig, server):
        old = rig.read_gains()
        assert (old.K, old.Ti_s) == (pytest.approx(config.controller.K), config.controller.Ti_s)
        new = rig.holdable(PIDController(K=-0.0247, Ti_s=3.6))
        rig.write_gains(new)
        assert rig.read_gains() == new
        assert server.device.value["gains.Gain"] == pytest.approx(-0.0247)


def test_gains_in_a_block_with_optimised_access_are_said_before_anything_is_written(tmp_path: Path) -> None:
    config = ball(tmp_path)
    there = {"form": "siemens", "settings": {"Gain": "DB2.DBD0", "Ti": "DB2.DBD4"}}
    with served_ball(config) as (_, server):
        said = refused(rig_of(with_signals(config, gains=there)))
        assert "DB2.DBD0: gains.Gain is in a block that cannot be reached: it has optimised access" in said
        assert "'Optimized block access' off" in said
        assert server.device.value["heartbeat"] == 0.0


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        (
            {"y": "DB9.DBD0"},
            "DB9.DBD0: y is in a block that cannot be reached: it has optimised access, or is not there",
        ),
        ({"y": "DB10.DBD44"}, "DB10.DBD44: y cannot be reached: the block has optimised access, or is too short"),
    ],
)
def test_a_place_that_cannot_be_reached_is_named(tmp_path: Path, changes: dict[str, Any], named: str) -> None:
    config = ball(tmp_path)
    with served_ball(config) as (_, server):
        assert named in refused(rig_of(with_signals(config, **changes)))
        assert server.device.value["heartbeat"] == 0.0


def answering(code: int, function: int) -> Any:
    """Have the line between host and CPU carry another return code of a function."""

    def tamper(frame: bytes, direction: str) -> list[tuple[float, bytes]]:
        # TPKT, COTP, header of 12 bytes, function, number of items, return code
        if direction == "to host" and len(frame) > 21 and frame[8] == 3 and frame[19] == function:
            frame = frame[:21] + bytes([code]) + frame[22:]
        return [(0.0, frame)]

    return tamper


@pytest.mark.parametrize(
    ("code", "function", "named"),
    [
        (0x03, 5, "u may not be accessed: the block is write-protected, or PUT/GET is not permitted"),
        (0x03, 4, "y may not be accessed"),
        (0x06, 4, "y is refused with its data type"),
    ],
)
def test_a_refusal_of_the_cpu_is_named_with_the_place(tmp_path: Path, code: int, function: int, named: str) -> None:
    config = ball(tmp_path)
    assert isinstance(config.rig, S7Settings)
    with served_ball(config), TcpRelay(config.rig.port, answering(code, function), tpkt_length) as relay:
        assert named in refused(rig_of(config, port=relay.port))


def test_a_cpu_that_does_not_know_the_slot_ends_the_connection_and_the_slot_is_named(tmp_path: Path) -> None:
    config = ball(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def hang_up() -> None:
            client, _ = listener.accept()
            client.recv(100)
            client.close()

        thread = threading.Thread(target=hang_up)
        thread.start()
        said = refused(rig_of(config, port=listener.getsockname()[1], retries=0))
        thread.join()
    assert "rack 0 slot 1: the CPU refuses the connection; check rig.rack and rig.slot" in said


def test_nobody_at_the_address_and_nobody_who_answers_are_told_apart(tmp_path: Path) -> None:
    config = ball(tmp_path)
    assert "no connection (" in refused(rig_of(config))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        assert "no answer; " in refused(rig_of(config, port=listener.getsockname()[1], timeout_s=0.1, retries=0))


def test_a_cpu_in_stop_is_not_taken_and_one_that_stops_ends_the_session(tmp_path: Path) -> None:
    config = ball(tmp_path)
    with served_ball(config) as (rig, server):
        server.stop_program()
        assert "the CPU is in STOP; switch it to RUN" in refused(rig)
        server.start_program()
        rig.open()
        rig.write(4.0)
        server.stop_program()
        assert server.device.output == 0.0
        rig.write(4.0)
        rig.clock.sleep_until(rig.clock.now() + 0.2)  # longer than a program may echo late
        with pytest.raises(LinkError, match="the CPU is in STOP"):
            rig.read()


def test_a_cpu_in_stop_is_noticed_without_an_echo_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.s7._LOOK_S", 0.0)
    config = with_signals(ball(tmp_path), heartbeat_echo=None)
    with served_ball(config) as (rig, server):
        rig.open()
        rig.read()
        server.stop_program()
        with pytest.raises(LinkError, match="the CPU is in STOP"):
            rig.read()


def test_a_cpu_that_restarts_is_met_by_a_new_connection_and_the_sample_is_suspect(tmp_path: Path) -> None:
    config = ball(tmp_path, retries=3)
    with served_ball(config) as (rig, first):
        link: Any = rig
        link._link.connect()
        assert not link._ask()[0].suspect
        first.__exit__(None, None, None)
        with served_ball(config):
            reading, _ = link._ask()
            assert reading.suspect
            assert 0.0 <= reading.y <= 10.0


def test_a_host_that_falls_silent_leaves_the_device_to_its_dead_man(tmp_path: Path) -> None:
    with served_ball(ball(tmp_path)) as (rig, server):
        rig.open()
        rig.write(4.0)
        rig.clock.sleep_until(rig.clock.now() + 0.8)
        assert server.device.output == 0.0
        with pytest.raises(LinkError, match="took the actuator back"):
            rig.read()


def test_probe_reads_every_place_once_and_says_what_looks_wrong(tmp_path: Path) -> None:
    config = ball(tmp_path)
    with served_ball(config) as (_, server):
        assert isinstance(config.rig, S7Settings)
        found = probe_kind(config.rig, {"y": (5.0, 9.0)})
        assert {one.name for one in found.signals} == set(config.rig.signals.mapped())
        assert [one.name for one in found.signals if one.warnings] == ["y"]
        assert "rack 0 slot 1, in RUN; a sample takes" in found.description
        assert re.search(r"cyclic reads keep up with sample times from [125]0* ms on$", found.description)
        wrong = with_signals(config, y={"address": "DB10.DBD28", "type": "DINT"}, setpoint="DB9.DBD0")
        assert isinstance(wrong.rig, S7Settings)
        server.device.show("setpoint", 7.0)
        told = {one.name: one.warnings for one in probe_kind(wrong.rig, {"y": (5.0, 9.0)}).signals}
        assert told["y"][1] == 'would be 7 with type = "REAL"'
        assert "optimised access" in told["setpoint"][0]
        assert server.device.value["heartbeat"] == 0.0
    assert kind_of(config.rig).reach_of(config.rig).address == ("127.0.0.1", config.rig.port)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"y": "DB10.DBW0.1"}, "a bit follows DBX"),
        ({"y": "MD4"}, 'is no place in a data block: write "DB10.DBD4"'),
        ({"y": {"address": "DB10.DBW0", "type": "REAL"}}, "'DB10.DBW0' holds no REAL: that is a DBD"),
        ({"y": {"address": "DB10.DBD0", "type": "LREAL"}}, "holds no LREAL: that is a DBX at .0"),
        ({"y": "DB10.DBX0.1"}, "y at DB10.DBX0.1 is a number, and no BOOL"),
        ({"u_applied": "DB11.DBD0"}, "u at DB11.DBW0 and u_applied at DB11.DBD0 overlap"),
        ({"enable": "DB11.DBX8.5"}, "enable at DB11.DBX8.5 and automatic at DB11.DBX8.5 overlap"),
        ({"enable": "DB13.DBD0"}, "enable at DB13.DBD0 is true or false"),
        ({"heartbeat_echo": "DB10.DBW8"}, "heartbeat is a WORD and heartbeat_echo a INT"),
    ],
)
def test_a_place_that_cannot_be_meant_is_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        s7_settings(102, PLACES | changes)


def test_signals_far_apart_are_read_in_several_requests() -> None:
    apart = PLACES | {"in_command": "DB10.DBX900.0", "u_applied": {"address": "DB14.DBD4", "type": "REAL"}}
    with s7_bench(free_port(), signals=apart) as bench:
        bench.rig.open()
        bench.rig.write(0.25)
        assert bench.rig.read().u_applied == pytest.approx(0.25)


def test_an_address_that_is_taken_is_said(tmp_path: Path) -> None:
    config = ball(tmp_path)
    with served_ball(config), pytest.raises(InputError, match="Address already in use"), served_ball(config):
        pass


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_run_on_the_cpu_is_accepted_and_kept_by_the_device(tmp_path: Path) -> None:
    from autotune.pipeline import tune

    config = ball(tmp_path)
    with served_ball(config) as (rig, server):
        tuning = tune(rig, config, tmp_path)
        assert tuning.verification is not None
        assert tuning.verification.accepted, tuning.verification.reason
        assert tuning.verification.by == "device"
        assert server.device.value["gains.Gain"] == pytest.approx(tuning.analysis.controller.K, rel=1e-6)
