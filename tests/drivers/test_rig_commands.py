"""``autotune rig``, ``probe`` and ``ports`` as a person uses them."""

from __future__ import annotations

import ctypes
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.config import load_config
from autotune.errors import InputError, LinkError
from drivers import open_rig, twin_of

CONFIGS = Path(__file__).parents[2] / "configs"


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def config_like(name: str, folder: Path, **lines: object) -> Path:
    """Write a copy of a configuration, with lines ``key = value`` replaced."""
    text = (CONFIGS / name).read_text()
    for key, value in lines.items():
        shown = f'"{value}"' if isinstance(value, str | Path) else str(value)
        rows = [f"{key} = {shown}" if row.split("=")[0].strip() == key else row for row in text.splitlines()]
        text = "\n".join(rows) + "\n"
    path = folder / name
    path.write_text(text)
    return path


@contextmanager
def served(config: Path) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "autotune.cli", "rig", str(config)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            assert process.stdout is not None
            said = ""
            for line in process.stdout:
                said += line
                if line.startswith("serving"):
                    break
            else:
                pytest.fail(said)
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
                process.wait(20)


def test_the_served_ball_can_be_probed_and_flown_and_ends_when_asked(tmp_path: Path) -> None:
    path = config_like("ball_modbus_tcp.toml", tmp_path, port=free_port())
    config = load_config(path)
    limits = config.limits
    with served(path) as process:
        done = CliRunner().invoke(app, ["probe", str(path)])
        assert done.exit_code == 0, done.output
        assert "14 registers read, nothing written: all values are plausible" in done.output
        rig = open_rig(config.rig, u_range=(limits.u_min, limits.u_max), u_safe=limits.u_safe)
        rig.open()
        on_the_floor = rig.read().y
        assert on_the_floor == pytest.approx(10.0, abs=0.4)
        start_s = rig.clock.now()
        while rig.clock.now() < start_s + 1.0:
            rig.write(8.0)
            rig.clock.sleep_until(rig.clock.now() + 0.01)
            y = rig.read().y
        assert y < 5.0  # it flies, and the sensor looks down
        rig.make_safe()
        rig.close()
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0


def test_a_served_rig_that_was_held_up_says_for_how_long(tmp_path: Path) -> None:
    config = load_config(path := config_like("ball_modbus_tcp.toml", tmp_path, port=free_port()))
    with served(path) as process:
        rig = open_rig(config.rig, u_range=(config.limits.u_min, config.limits.u_max), u_safe=config.limits.u_safe)
        rig.open()
        process.send_signal(signal.SIGSTOP)
        os.waitpid(process.pid, os.WUNTRACED)  # the signal was sent, the process may run on for a while
        try:
            with pytest.raises(LinkError, match="no answer"):  # after two attempts of 0.2 s
                rig.read()
        finally:
            process.send_signal(signal.SIGCONT)
        rig.make_safe()
        rig.close()
        process.send_signal(signal.SIGINT)
        assert process.stdout is not None
        said = re.search(r"stopped; the plant was up to ([\d.]+) ms late", process.stdout.read())
        assert said is not None
        assert 300 < float(said[1]) < 5000


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="threads of another process are listed on Linux only")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_served_rig_ends_by_a_signal_that_another_thread_takes(tmp_path: Path, number: signal.Signals) -> None:
    """The kernel gives a signal to any thread where the main one is held up, as while a stopped process goes on."""
    path = config_like("ball_modbus_tcp.toml", tmp_path, port=free_port())
    with served(path) as process:
        threads = {int(one.name) for one in Path(f"/proc/{process.pid}/task").iterdir()} - {process.pid}
        assert ctypes.CDLL(None).tgkill(process.pid, min(threads), number) == 0
        assert process.wait(20) == 0


def test_a_serial_rig_makes_its_own_line_and_clears_it_away(tmp_path: Path) -> None:
    device = tmp_path / "ball"
    path = config_like("ball_modbus_rtu.toml", tmp_path, device=device)
    with served(path):
        assert device.is_symlink()
        done = CliRunner().invoke(app, ["probe", str(path)])
        assert done.exit_code == 0, done.output
        assert "nothing written" in done.output
    assert not device.is_symlink()


def test_a_rig_behind_tls_is_probed_with_the_hosts_certificate(tmp_path: Path, certificates: Path) -> None:
    text = config_like("ball_modbus_tls.toml", tmp_path, port=free_port()).read_text()
    path = tmp_path / "tls.toml"
    path.write_text(text.replace('"certificates/', f'"{certificates}/'))
    with served(path):
        done = CliRunner().invoke(app, ["probe", str(path)])
        assert done.exit_code == 0, done.output
        assert "nothing written" in done.output


def test_a_rig_without_registers_or_without_a_twin_cannot_be_served(tmp_path: Path) -> None:
    simulated = CliRunner().invoke(app, ["rig", str(CONFIGS / "servo_sim.toml")])
    assert isinstance(simulated.exception, InputError)
    assert "has no registers" in str(simulated.exception)
    text = (CONFIGS / "ball_modbus_tcp.toml").read_text()
    before, after = text.split("\n[rig.twin]")
    path = tmp_path / "real.toml"
    path.write_text(before + after[after.index("[signals]") :])
    real = CliRunner().invoke(app, ["rig", str(path)])
    assert isinstance(real.exception, InputError)
    assert "[rig.twin]" in str(real.exception)


def test_a_dead_man_shorter_than_a_sample_is_refused(tmp_path: Path) -> None:
    path = config_like("ball_modbus_tcp.toml", tmp_path, sample_time_s=1.0, budget_s=120.0)
    done = CliRunner().invoke(app, ["rig", str(path)])
    assert isinstance(done.exception, InputError)
    assert "runs out between two samples" in str(done.exception)


def test_a_taken_address_is_said(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        path = config_like("ball_modbus_tcp.toml", tmp_path, port=taken.getsockname()[1])
        done = CliRunner().invoke(app, ["rig", str(path)])
    assert isinstance(done.exception, InputError)
    assert "free the address" in str(done.exception)


def test_probing_where_nobody_is_ends_with_a_link_error(tmp_path: Path) -> None:
    path = config_like("ball_modbus_tcp.toml", tmp_path, port=free_port())
    done = CliRunner().invoke(app, ["probe", str(path)])
    assert isinstance(done.exception, LinkError)
    assert "no connection" in str(done.exception)


def test_ports_are_listed() -> None:
    done = CliRunner().invoke(app, ["ports"])
    assert done.exit_code == 0
    assert "serial port" in done.output


@pytest.mark.parametrize("name", ["ball_modbus_tcp.toml", "ball_modbus_rtu.toml", "ball_modbus_tls.toml"])
def test_a_real_rigs_dry_run_has_the_plant_of_its_twin(name: str) -> None:
    config = load_config(CONFIGS / name)
    twin = twin_of(config.rig)
    assert (twin.kind, twin.plant, twin.noise) == ("simulated", "ball", 0.35)


@pytest.mark.parametrize("name", ["ball_modbus_tcp.toml", "ball_modbus_rtu.toml", "ball_modbus_tls.toml"])
def test_only_the_rig_table_differs_from_the_run_in_process(name: str) -> None:
    over_a_line = load_config(CONFIGS / name).model_dump(exclude={"rig", "name"})
    in_process = load_config(CONFIGS / "ball_sim.toml").model_dump(exclude={"rig", "name"})
    assert over_a_line == in_process


@pytest.mark.parametrize("name", sorted(path.name for path in CONFIGS.glob("*.toml")))
def test_every_configuration_loads(name: str) -> None:
    assert load_config(CONFIGS / name).name
