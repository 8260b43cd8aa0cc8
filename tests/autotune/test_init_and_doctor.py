"""First steps: a configuration from few answers, and whether this computer is ready."""

from __future__ import annotations

import os
import pty
import re
import socket
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.cli.init_questions import number
from autotune.config import load_config
from autotune.config.registers import RegisterMap
from autotune.config.rig import ModbusTcpSettings, SerialSettings, SimulatedRigSettings
from autotune.equations.transfer_text import parse_transfer_function
from autotune.errors import InputError
from autotune.model_tables import read_model
from drivers.kinds import KINDS
from tests.benchmarks.twins import PLANTS

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
REAL = [
    *("--sample-time", "0.1", "--u-unit", "V", "--y-unit", "cm"),
    *("--u-range", "0", "10", "--u-safe", "0", "--y-range", "10", "90", "--y", "50", "--u", "4"),
]
SERIAL = ["--device", "/dev/ttyS9", "--y-span", "0", "100", "--u-span", "0", "10"]
MODBUS = ["--y-register", "input:0:float32", "--u-register", "holding:0:float32"]


def command(*arguments: str | Path) -> str:
    return CliRunner().invoke(app, [*map(str, arguments)], catch_exceptions=False, standalone_mode=False).output


@pytest.mark.parametrize(
    ("plant", "file"), [("ball", "ball_sim"), ("servo", "servo_sim"), ("two_tank", "two_tank_sim")]
)
def test_a_simulated_rig_is_described_as_the_shipped_configuration_does(tmp_path: Path, plant: str, file: str) -> None:
    path = tmp_path / "rig.toml"
    command("init", path, "--kind", "simulated", "--plant", plant)
    shipped = load_config(CONFIGS / f"{file}.toml")
    assert load_config(path).model_copy(update={"name": shipped.name}) == shipped


@pytest.mark.parametrize(
    ("kind", "reached"),
    [
        ("modbus_tcp", ["--host", "10.0.0.2", *MODBUS]),
        ("modbus_tls", ["--host", "10.0.0.2", *MODBUS]),
        ("modbus_rtu", ["--device", "/dev/ttyUSB0", *MODBUS]),
        ("opcua", ["--endpoint", "opc.tcp://h:4840", "--y-node", "ns=2;s=y", "--u-node", "2:Rig/2:u"]),
        ("s7", ["--host", "10.0.0.2", "--y-place", "DB10.DBD0", "--u-place", "DB10.DBD4"]),
        ("serial", ["--device", "/dev/ttyACM0", "--y-span", "0", "100", "--u-span", "0", "10"]),
        ("replay", ["--recording", "rig.csv"]),
    ],
)
def test_what_is_written_loads_and_keeps_the_answers(tmp_path: Path, kind: str, reached: list[str]) -> None:
    path = tmp_path / "rig.toml"
    plant = [] if kind == "replay" else ["--plant", "ball"]
    command("init", path, "--kind", kind, *reached, *REAL, *plant)
    config = load_config(path)
    assert config.rig.kind == kind
    assert (config.limits.u_min, config.limits.u_max, config.limits.u_safe) == (0.0, 10.0, 0.0)
    assert (config.operating_point.y, config.operating_point.u_guess) == (50.0, 4.0)
    assert config.operating_point.y - config.limits.swing >= config.limits.y_min


def test_every_kind_that_there_is_a_driver_for_can_be_described(tmp_path: Path) -> None:
    answers = [*MODBUS, *REAL, "--host", "h", "--device", "/dev/ttyS9", "--recording", "r.csv"]
    answers += ["--y-span", "0", "1", "--u-span", "0", "10"]
    answers += ["--endpoint", "opc.tcp://h:4840", "--y-node", "ns=2;s=y", "--u-node", "2:Rig/2:u"]
    answers += ["--y-place", "DB10.DBD0", "--u-place", "DB10.DBD4"]
    for kind in KINDS:
        path = tmp_path / f"{kind.name}.toml"
        command("init", path, "--kind", kind.name, *answers, *(["--plant", "ball"] if kind.name == "simulated" else []))
        assert isinstance(load_config(path).rig, kind.settings)
    with pytest.raises(InputError, match="'x' is none of simulated, replay, modbus_tcp"):
        command("init", tmp_path / "x.toml", "--kind", "x")


def test_every_field_of_the_register_map_and_every_other_key_has_a_flag(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    (tmp_path / "plant.toml").touch()
    registers = {name: f"holding:{10 + 2 * i}:uint16" for i, name in enumerate(RegisterMap.model_fields)}
    for name in ("y", "u", "gains", "unlock", "heartbeat_echo"):
        del registers[name]
    flags = [part for name, place in registers.items() for part in ("--register", f"{name}={place}")]
    flags += ["--register", "heartbeat_echo=input:40:int64,word_order=little,scale=1e-3"]
    flags += ["--set", 'rig.registers.unlock={ address = 90, type = "uint16", code = 4711 }', "--set", "rig.port=1502"]
    flags += ["--set", "limits.u_rate=5", "--set", "audit_log=gains.jsonl", "--model", str(tmp_path / "plant.toml")]
    command("init", path, "--kind", "modbus_tcp", "--host", "10.0.0.2", *MODBUS, *REAL, *flags)
    config = load_config(path)
    assert isinstance(config.rig, ModbusTcpSettings)
    mapped = config.rig.registers.mapped()
    assert set(mapped) == {*registers, "y", "u", "heartbeat_echo"}
    assert (mapped["K"].address, mapped["K"].type) == (10 + 2 * list(RegisterMap.model_fields).index("K"), "uint16")
    echo = mapped["heartbeat_echo"]
    assert (echo.table, echo.type, echo.word_order, echo.scale) == ("input", "int64", "little", 1e-3)
    assert config.rig.registers.unlock is not None
    assert (config.rig.port, config.limits.u_rate, config.audit_log) == (1502, 5.0, "gains.jsonl")
    assert config.rig.twin is not None
    assert config.rig.twin.model == str(tmp_path / "plant.toml")


def test_gains_in_a_makers_form_bits_and_codes_have_flags(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    flags = ["--register", "gains.PB_percent=holding:30,scale=0.1"]
    flags += ["--set", "rig.registers.gains.form=proportional-band"]
    flags += ["--register", "enable=holding:20,bit=3", "--register", "in_command=input:21,on=7"]
    command("init", path, "--kind", "modbus_tcp", "--host", "10.0.0.2", *MODBUS, *REAL, *flags)
    config = load_config(path)
    assert isinstance(config.rig, ModbusTcpSettings)
    assert config.rig.registers.held_gains is not None
    assert config.rig.registers.held_gains.form == "proportional-band"
    mapped = config.rig.registers.mapped()
    assert (mapped["enable"].bit, mapped["in_command"].codes) == (3, (7, 0))


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (["--register", "enable"], "NAME=TABLE:ADDRESS"),
        (["--register", "enable=coil"], "TABLE:ADDRESS"),
        (["--register", "enable=coil:1", "--register", "enable=coil:2"], "given twice"),
        (["--register", "enabel=coil:1"], "did you mean 'enable'"),
        (["--register", "enable=holding:1,bit"], "KEY=VALUE is wanted"),
        (["--set", "rig.port"], "KEY=VALUE is wanted"),
        (["--set", "rig.kind.x=1"], "kind is no table"),
        (["--set", "rig.prot=1"], "did you mean 'port'"),
    ],
)
def test_a_flag_that_says_nothing_is_refused_and_nothing_is_written(
    tmp_path: Path, flags: list[str], reason: str
) -> None:
    path = tmp_path / "rig.toml"
    with pytest.raises(InputError, match=reason):
        command("init", path, "--kind", "modbus_tcp", "--host", "h", *MODBUS, *REAL, *flags)
    assert not path.exists()


def test_the_time_of_a_first_run_follows_from_the_sample_time(tmp_path: Path) -> None:
    for sample_s in (0.01, 1.0):
        path = tmp_path / f"rig_{sample_s:g}.toml"
        given = ["--kind", "modbus_tcp", "--host", "h", *MODBUS, *REAL, "--sample-time", f"{sample_s}"]
        command("init", path, *given)
        config = load_config(path)
        assert config.experiment.budget_s == pytest.approx(1e4 * sample_s)
        assert config.limits.time_s == 4.0 * config.experiment.budget_s


def test_every_key_of_the_schema_is_in_the_file_with_its_meaning_and_every_default_can_be_uncommented(
    tmp_path: Path,
) -> None:
    path = tmp_path / "rig.toml"
    command(
        "init", path, "--kind", "serial", "--device", "/dev/ttyACM0", "--y-span", "0", "9", "--u-span", "0", "9", *REAL
    )
    text = path.read_text()
    for name in set(SerialSettings.model_fields) - {"twin"}:
        assert f"{name} = " in text
    assert "silence of the host after which the device is safe [s]" in text
    lines = [line.removeprefix("#: ") for line in text.splitlines()]
    valued = [line for line in lines if "=" not in line or line.split("#")[0].split("=", 1)[1].strip()]
    sections = tomllib.loads("\n".join(valued).replace("[controller]\n", ""))
    assert sections["design"]["specification"] == "Spec1"


def test_away_from_a_terminal_every_missing_answer_is_named_and_nothing_is_written(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    with pytest.raises(InputError, match=r"--host, --y-register.*--u-safe"):
        command("init", path, "--kind", "modbus_tcp")
    with pytest.raises(InputError, match="u_safe = 0 must lie within"):
        command("init", path, "--kind", "modbus_tcp", "--host", "h", *MODBUS, *REAL, "--u-range", "2", "10")
    assert not path.exists()


def test_a_file_that_exists_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text("mine")
    with pytest.raises(InputError, match="nothing is overwritten"):
        command("init", path, "--kind", "simulated", "--plant", "ball")
    assert path.read_text() == "mine"


def typed(arguments: list[str], answers: str, folder: Path) -> tuple[str, int]:
    """Run the command for a person at a terminal; return what stood there and the exit status."""
    leader, follower = pty.openpty()
    child = subprocess.Popen(
        [sys.executable, "-m", "autotune.cli", *arguments],
        cwd=folder, stdin=follower, stdout=follower, stderr=follower,
    )  # fmt: skip
    os.close(follower)
    os.write(leader, answers.encode())
    said = b""
    while True:
        try:
            said += os.read(leader, 4096)
        except OSError:  # the other end is closed
            break
    os.close(leader)
    return said.decode(), child.wait()


def test_at_a_terminal_questions_are_asked_and_asked_again_after_a_wrong_answer(tmp_path: Path) -> None:
    said, status = typed(["init", "rig.toml"], "simulated\nbowl\nball\n", tmp_path)
    assert status == 0, said
    assert "'bowl' is none of ball, servo, two_tank, thermal" in said
    assert load_config(tmp_path / "rig.toml").rig.kind == "simulated"


def test_at_a_terminal_enter_takes_what_is_suggested(tmp_path: Path) -> None:
    said, status = typed(["init", "ball.toml"], "\n\n", tmp_path)
    assert status == 0, said
    assert load_config(tmp_path / "ball.toml").rig.plant == "ball"  # type: ignore[union-attr]


@pytest.mark.parametrize("limits", ["0,100", "0 100", "0, 100"])
def test_limits_are_taken_with_comma_or_space_and_their_middle_is_suggested(limits: str, tmp_path: Path) -> None:
    answers = f"simulated\nK=2 T=10 L=1\n%\ndegC\n1\n{limits}\n0\n20 80\n\n30\n"
    said, status = typed(["init", "oven.toml"], answers, tmp_path)
    assert status == 0, said
    content = load_config(tmp_path / "oven.toml")
    assert (content.limits.u_min, content.limits.u_max) == (0.0, 100.0)
    assert content.operating_point.y == 50.0


def test_an_answer_that_cannot_be_is_asked_for_again_at_once(tmp_path: Path) -> None:
    reached = "modbus_tcp\nplc\ninput:0:float32\nholding:0:float32\n192.168.1.10\nnone.toml\n\n"
    answers = f"{reached}%\nbar\nfast\n1\n100 0\n0 100\n-5\n0\n0 10\n20\n5\n30\n"
    said, status = typed(["init", "plc.toml"], answers, tmp_path)
    assert status == 0, said
    refused = re.findall("Error: (.*)", said)
    assert len(refused) == 6
    assert "no sign stands between the numbers 192.168 and .1" in refused[0]
    assert "no such file" in refused[1]
    assert "'fast' is no number" in refused[2]
    assert "the lowest is to be below the highest" in refused[3]
    assert "-5 is not within 0 to 100" in refused[4]
    assert "20 is not within 0 to 10" in refused[5]
    content = load_config(tmp_path / "plc.toml")
    assert (content.limits.u_max, content.operating_point.y, content.operating_point.u_guess) == (100.0, 5.0, 30.0)


def test_enter_where_an_answer_is_needed_is_said_to_be_none_and_a_kind_may_have_a_hyphen(tmp_path: Path) -> None:
    answers = "modbus-tcp\n\nplc\ninput:0:float32\nholding:0:float32\n\n%\nbar\n1\n0 100\n0\n0 10\n\n\n30\n"
    said, status = typed(["init", "plc.toml"], answers, tmp_path)
    assert status == 0, said
    assert said.count("Error: an answer is needed; Ctrl-C leaves, and nothing is written") == 2
    assert "[]" not in said
    assert load_config(tmp_path / "plc.toml").rig.kind == "modbus_tcp"


def test_what_comes_next_of_a_rig_that_cannot_be_probed_is_a_run(tmp_path: Path) -> None:
    said = command("init", tmp_path / "again.toml", "--kind", "replay", "--recording", "rec.csv", *REAL)
    assert "next: autotune run" in said
    with pytest.raises(InputError, match="no registers and nothing else to read"):
        command("probe", tmp_path / "again.toml")


@pytest.mark.parametrize(("u", "uncertainty"), [("30", 5.0), ("2.5", 1.2), ("97", 1.5)])
def test_the_first_pushes_of_a_rig_stay_within_the_range_of_its_command(
    tmp_path: Path, u: str, uncertainty: float
) -> None:
    answers = f"simulated\nK=2 T=10 L=1\n%\nbar\n1\n0 100\n0\n0 10\n\n{u}\n"
    said, status = typed(["init", "rig.toml"], answers, tmp_path)
    assert status == 0, said
    assert load_config(tmp_path / "rig.toml").operating_point.u_uncertainty == uncertainty


def test_a_transfer_function_as_it_is_written_becomes_the_model_of_twin_or_simulated_rig(tmp_path: Path) -> None:
    written = "-65.5/(s(0.36s+1)) e^-0.1s"
    command("init", tmp_path / "oven.toml", "--kind", "simulated", "--model", "K=2 T=10,2 L=0.5", *REAL)
    rig = load_config(tmp_path / "oven.toml").rig
    assert isinstance(rig, SimulatedRigSettings)
    oven = read_model(tmp_path / "oven_model.toml")
    assert rig.model == str(tmp_path / "oven_model.toml")
    assert oven.transfer_function().response(np.array([0.0]))[0] == pytest.approx(2.0)
    assert (oven.input.offset, oven.output.offset) == (4.0, 50.0)  # around the operating point
    command("init", tmp_path / "tube.toml", "--kind", "serial", *SERIAL, "--model", written, *REAL)
    twin = load_config(tmp_path / "tube.toml").rig.twin  # type: ignore[union-attr]
    assert twin is not None
    assert twin.model == str(tmp_path / "tube_model.toml")
    assert read_model(twin.model).blocks[0].dynamics == parse_transfer_function(written)
    (tmp_path / "tube.toml").unlink()
    with pytest.raises(InputError, match=r"tube_model.toml: exists already"):
        command("init", tmp_path / "tube.toml", "--kind", "serial", *SERIAL, "--model", written, *REAL)
    with pytest.raises(InputError, match=r"'f' has no meaning here; write it as"):
        command("init", tmp_path / "x.toml", "--kind", "serial", *SERIAL, "--model", "foo(s", *REAL)
    assert not (tmp_path / "x.toml").exists()


def test_at_a_terminal_the_transfer_function_is_asked_for_until_it_can_be_read(tmp_path: Path) -> None:
    answers = "K 1 s\nK=2 T=10 L=1\n"
    said, status = typed(["init", "rig.toml", "--kind", "simulated", *REAL], answers, tmp_path)
    assert status == 0, said
    assert "no transfer function" in said
    assert (tmp_path / "rig_model.toml").exists()
    said, status = typed(["init", "real.toml", "--kind", "serial", *SERIAL, *REAL], "1/(s+1)\n", tmp_path)
    assert status == 0, said
    assert "a twin for --dry-run" in said
    assert read_model(tmp_path / "real_model.toml").name == "real: 1/(s+1)"


@pytest.mark.parametrize(
    ("name", "units"),
    [("init", ["[s]", "[u unit]", "[y unit]"]), ("tune", ["[deg]", "[rad/s]"]), ("reference", ["[u unit/s]", "[s]"])],
)
def test_help_shows_the_units_of_what_is_asked_for(name: str, units: list[str]) -> None:
    shown = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "300", "TERMINAL_WIDTH": "300"}).output
    assert [unit for unit in units if unit not in shown] == []


@pytest.mark.parametrize("call", [[], ["run"], ["diagnose"], ["identify"], ["paper", "relay"], ["watch"]])
def test_help_shows_a_call_as_one_types_it(call: list[str]) -> None:
    shown = CliRunner().invoke(app, [*call, "--help"], env={"COLUMNS": "300", "TERMINAL_WIDTH": "300"}).output
    assert [
        word for word in ("bool", "range>", "list[", "{", "[[", "]]") if word in shown.replace("<list[Path]>", "")
    ] == []


def test_every_command_stands_in_a_group_of_the_tour() -> None:
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "300", "TERMINAL_WIDTH": "300"}).output
    assert "─ Commands ─" not in shown


def test_a_computer_that_runs_these_tests_is_ready(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    said = command("doctor", CONFIGS / "ball_sim.toml")
    assert "ready" in said
    assert re.search(r"scheduling: a sample every 10 ms: .* ms in 99 %, .* at worst; \d+ of 200 deadlines missed", said)
    assert re.search(r"real-time priority \d+|chrt --fifo \d+ autotune run", said)
    assert list(tmp_path.iterdir()) == []


def test_a_rig_that_takes_no_connection_and_a_device_that_is_not_there_are_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, and nobody listens
        port = taken.getsockname()[1]
        text = (CONFIGS / "ball_modbus_tcp.toml").read_text()
        Path("tcp.toml").write_text(text.replace("port = 5020", f"port = {port}"))
        with pytest.raises(InputError, match=r"not ready for a run: the rig's address; switch it on"):
            command("doctor", "tcp.toml")
    text = (CONFIGS / "ball_serial.toml").read_text()
    Path("serial.toml").write_text(text.replace("/tmp/autotune-ball-serial", str(tmp_path / "no-port")))
    with pytest.raises(InputError, match=r"not ready for a run: the rig's port.*autotune ports"):
        command("doctor", "serial.toml")


def test_a_configuration_that_does_not_load_and_certificates_that_are_missing_are_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("broken.toml").write_text('name = "x"\n')
    with pytest.raises(InputError, match="configuration"):
        command("doctor", "broken.toml")
    with pytest.raises(InputError, match=r"certificates/ca\.pem, certificates/host\.pem, certificates/host\.key"):
        command("doctor", CONFIGS / "ball_modbus_tls.toml")


def test_a_compiler_that_cannot_keep_its_code_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "missing"))
    assert "set NUMBA_CACHE_DIR to a folder you may write" in command("doctor")


@pytest.mark.parametrize("kind", ["simulated", "serial"])
def test_a_twin_of_a_transfer_function_has_a_sensor_as_rigs_have(tmp_path: Path, kind: str) -> None:
    """A noise-free one that rests sent the same reading again and again, which is a stale sensor."""
    path = tmp_path / "rig.toml"
    reach = SERIAL if kind == "serial" else []
    command("init", path, "--kind", kind, *reach, "--model", "2/((s+1)(0.5s+1))", *REAL)
    rig = load_config(path).rig
    twin = rig if isinstance(rig, SimulatedRigSettings) else rig.twin
    assert twin.noise == pytest.approx(0.001 * 80.0)
    assert twin.resolution == pytest.approx(80.0 / 4096.0, rel=0.05)


def test_a_run_hands_nothing_over_where_a_second_person_is_asked_for(tmp_path: Path) -> None:
    path, plant = tmp_path / "rig.toml", PLANTS[2]
    command("init", path, "--kind", "simulated", "--model", plant.written, *plant.answers)
    path.write_text(path.read_text() + "\n[approval]\n")
    said = command("run", path, "--out", tmp_path / "out")
    assert "Accepted" in said
    assert "not handed over: [approval] asks for a second person: autotune deploy" in said
    assert (tmp_path / "out" / "journal.jsonl").read_text().count("gains") == 1  # read, and nothing written
    assert not (tmp_path / "out" / "audit.jsonl").exists()


def test_a_decimal_comma_is_taken_where_one_number_is_asked_and_said(tmp_path: Path) -> None:
    """The comma of a pair parts its numbers; between blanks each may have a decimal comma of its own."""
    answers = "simulated\nK=2 T=10 L=1\n%\ndegC\n0,5\n0,100\n1,25\n20,5 80\n\n30\n"
    said, status = typed(["init", "oven.toml"], answers, tmp_path)
    assert status == 0, said
    assert re.findall(r"\S+ is read as \S+", said) == [
        "0,5 is read as 0.5", "1,25 is read as 1.25", "20,5 is read as 20.5"
    ]  # fmt: skip
    content = load_config(tmp_path / "oven.toml")
    assert content.signals.sample_time_s == 0.5
    assert (content.limits.u_min, content.limits.u_max, content.limits.u_safe) == (0.0, 100.0, 1.25)
    assert (content.limits.y_min, content.limits.y_max) == (20.5, 80.0)


@pytest.mark.parametrize("answer", ["1.234,5", "1,234,5", "0,5,", "half"])
def test_what_may_be_two_numbers_is_none(answer: str) -> None:
    with pytest.raises(InputError, match="is no number"):
        number(answer)
