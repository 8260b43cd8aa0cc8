"""Gains handed to a real Modbus server over lines that break, by processes that are killed, and refused by people."""

from __future__ import annotations

import json
import math
import os
import pty
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import tomli_w
from typer.testing import CliRunner

from autotune.cli import app
from autotune.config import Config, load_config
from autotune.config.registers import RegisterMap
from autotune.controller import PIDController
from autotune.errors import DesignError, ExperimentStopped, InputError, LinkError, OperatorStop
from autotune.experiment.judgement import Verification
from autotune.experiment.loop import ControlLoop
from autotune.experiment.rig import TrialGains
from autotune.experiment.run import envelope_of
from autotune.pipeline.audit import AuditLog, audit_log, user
from autotune.pipeline.deployment import deploy, hand_over, restore
from autotune.pipeline.journal import Journal, Step
from autotune.points import FrequencyPoint, points_to_json
from autotune.recording import RecordingWriter
from drivers.simulated import SimulatedRig
from sim.modbus_rig import ModbusRig, TcpTransport
from sim.plant import make_plant
from sim.register_device import RegisterDevice
from tests.drivers.bench import REGISTERS, U_SAFE, register_device, rig_of, tcp_settings
from tests.drivers.tcp_relay import Direction, TcpRelay

ROOT = Path(__file__).resolve().parents[2]
#: K and Ti lie apart, so that two requests write them
APART = RegisterMap.model_validate(
    REGISTERS.model_dump() | {"Ti": {"address": 40, "type": "uint32", "scale": 1e-3, "word_order": "little"}}
)
#: what the device sets by itself when the host falls silent, before it was told U_SAFE
DEVICE_SAFE = 0.0
OLD, NEW = PIDController(K=1.5, Ti_s=2.0), PIDController(K=0.75, Ti_s=4.0)
MIXED = PIDController(K=0.75, Ti_s=2.0)
WRITE_REGISTERS, TI_ADDRESS = 16, 40


@dataclass(kw_only=True)
class Line:
    """A device behind a relay that cuts the line at the write of Ti, ``times`` times."""

    device: RegisterDevice
    relay: TcpRelay
    times: int = 0
    seen: Any = None

    def tamper(self, frame: bytes, direction: Direction) -> Sequence[tuple[float, bytes]]:
        is_Ti = (
            direction == "to device" and frame[7] == WRITE_REGISTERS and frame[8:10] == TI_ADDRESS.to_bytes(2, "big")
        )
        if is_Ti and self.times > 0:
            self.times -= 1
            if self.seen is not None:
                self.seen()
            return ()
        return ((0.0, frame),)

    def rig(self) -> Any:
        return rig_of(tcp_settings(self.relay.port, APART, timeout_s=0.5, retries=0))

    @property
    def gains(self) -> PIDController:
        return PIDController(K=self.device._values["K"], Ti_s=self.device._values["Ti"])


@pytest.fixture
def line() -> Iterator[Line]:
    device = register_device(APART)
    with ModbusRig(device, TcpTransport()) as server, TcpRelay(server.port) as relay:
        one = Line(device=device, relay=relay)
        relay.tamper = one.tamper
        yield one


def steps(journal: Path) -> list[str]:
    return [json.loads(text)["gains"] for text in journal.read_text().splitlines()]


def agreed(old: PIDController, new: PIDController) -> None:
    assert (old, new) == (OLD, NEW)


def refused(old: PIDController, new: PIDController) -> None:
    raise InputError("refused: nothing was written")


def verified(rig: Any, accepted: bool, by: Literal["host", "device"] = "device") -> Any:
    """Return a trial on a rig that ends at once with the verdict; what is under test is what follows from it."""
    curve: Any = None

    def try_out(held: PIDController, gains: TrialGains | None) -> Verification:
        figures: Any = None
        if gains is not None:
            gains.put_in()
            gains.take_out()
            rig.close()
        return Verification(
            accepted=accepted, reason="", test=curve, y=curve, u=curve, prediction=curve,
            rms_error=0.0, allowed=0.0, measured=figures, predicted=figures, predicted_sd=figures, by=by,
        )  # fmt: skip

    return try_out


def test_gains_are_written_read_back_tried_and_kept(line: Line, tmp_path: Path) -> None:
    tried, rig = [], line.rig()
    journal = tmp_path / "journal.jsonl"

    def try_out(held: PIDController, gains: TrialGains | None) -> Verification:
        assert gains is not None
        gains.put_in()
        tried.append((held, line.gains, steps(journal)))
        gains.take_out()
        assert line.gains == OLD
        rig.close()
        return verified(rig, True)(held, None)

    done = deploy(rig, NEW, journal, agree=agreed, try_out=try_out)
    assert done.kept
    assert (done.old, done.new, line.gains) == (OLD, NEW, NEW)
    assert tried == [(NEW, NEW, ["read", "writing", "written and read back, on trial"])]
    assert steps(journal)[-4:] == ["restoring", "restored", "writing", "verified, kept"]
    assert Journal(journal).unfinished() is None


def test_gains_whose_law_ran_in_the_host_alone_are_never_called_kept(line: Line, tmp_path: Path) -> None:
    rig = line.rig()
    journal = tmp_path / "journal.jsonl"
    done = deploy(rig, NEW, journal, agree=agreed, try_out=verified(rig, True, by="host"))
    assert (done.kept, line.gains) == (True, NEW)
    assert steps(journal)[-1] == "host's law verified; the device's own law not tried"
    assert Journal(journal).unfinished() is None


def test_gains_that_do_not_verify_are_taken_back(line: Line, tmp_path: Path) -> None:
    rig = line.rig()
    journal = tmp_path / "journal.jsonl"
    done = deploy(rig, NEW, journal, agree=agreed, try_out=verified(rig, False))
    assert not done.kept
    assert line.gains == OLD
    assert steps(journal)[-3:] == ["restoring", "restored", "not accepted, the old gains stay"]


def test_nothing_is_written_where_the_gains_are_refused(line: Line, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing was written"):
        deploy(line.rig(), NEW, tmp_path / "journal.jsonl", agree=refused, try_out=None)
    assert line.gains == OLD
    assert len(line.device.history) == 0  # the actuator stayed with whoever had it
    assert not (tmp_path / "journal.jsonl").exists()


def test_a_line_that_breaks_once_between_the_gains_leaves_the_old_ones(line: Line, tmp_path: Path) -> None:
    line.times = 1
    journal = tmp_path / "journal.jsonl"
    with pytest.raises(LinkError, match="the old gains are in place again"):
        deploy(line.rig(), NEW, journal, agree=agreed, try_out=None)
    assert line.gains == OLD
    assert Journal(journal).unfinished() is None


def test_ctrl_c_between_the_gains_leaves_the_old_ones(line: Line, tmp_path: Path) -> None:
    line.times, line.seen = 1, lambda: os.kill(os.getpid(), signal.SIGINT)
    journal = tmp_path / "journal.jsonl"
    with pytest.raises(OperatorStop, match=r"stopped by Ctrl-C: .*; the old gains are in place again") as stopped:
        deploy(line.rig(), NEW, journal, agree=agreed, try_out=None)
    assert stopped.value.exit_status == 130
    assert line.gains == OLD
    assert steps(journal) == ["read", "writing", "restoring", "restored"]


def test_a_second_ctrl_c_waits_until_the_old_gains_are_back(line: Line, tmp_path: Path) -> None:
    line.times, line.seen = 3, lambda: os.kill(os.getpid(), signal.SIGINT)  # the third hits the writing back
    rig = rig_of(tcp_settings(line.relay.port, APART, timeout_s=0.5, retries=3))
    with pytest.raises(OperatorStop, match="the old gains are in place again"):
        deploy(rig, NEW, tmp_path / "journal.jsonl", agree=agreed, try_out=None)
    assert line.gains == OLD


def test_a_journal_that_cannot_take_the_last_step_leaves_the_old_gains(
    line: Line, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = tmp_path / "journal.jsonl"
    real = Journal.note

    def full(self: Journal, step: Step, *given: Any) -> None:  # the disk fills with the line before
        if step is not Step.READ and step is not Step.WRITING:
            raise ExperimentStopped("the journal cannot be written (No space left on device)")
        real(self, step, *given)

    monkeypatch.setattr(Journal, "note", full)
    with pytest.raises(ExperimentStopped, match=r"No space left.*the old gains are in place again"):
        deploy(line.rig(), NEW, journal, agree=agreed, try_out=None)
    assert line.gains == OLD
    assert Journal(journal).unfinished() == OLD  # says less than is known, and nothing false


@pytest.mark.parametrize(
    ("read", "named"),
    [
        ('"K": null, "Ti_s": 2.0', "'K'|K"),
        ('"K": NaN, "Ti_s": 2.0', "K"),
        ('"K": "1.5", "Ti_s": 2.0', "K"),
        ('"K": 1.5', "'Ti_s' is missing"),
        ('"K": 1.5, "Ti_s": NaN', "Ti_s"),
        ('"K": 1e300, "Ti_s": 2.0', "K"),
        ('"K": 1.5, "Ti_s": 2.0, "Td": 1.0', "unknown key 'Td'"),
    ],
)
def test_gains_of_a_journal_that_no_rig_can_have_held_are_not_written(tmp_path: Path, read: str, named: str) -> None:
    journal = tmp_path / "journal.jsonl"
    journal.write_text(f'{{"gains": "read", {read}}}\n{{"gains": "writing", "K": 1.0, "Ti_s": 1.0}}\n')
    with pytest.raises(InputError, match=named):
        Journal(journal).unfinished()


def test_what_a_device_held_as_delivered_is_gone_back_to(tmp_path: Path) -> None:
    journal = tmp_path / "journal.jsonl"
    Journal(journal).note(Step.READ, PIDController(K=0.0, Ti_s=0.0))
    Journal(journal).note(Step.WRITING, NEW)
    assert Journal(journal).unfinished() == PIDController(K=0.0, Ti_s=0.0)


@pytest.mark.parametrize("text", ["[]\n", "1\n", '{"gains": "x"}\n', '{"gains": []}\n', "[" * 10_000 + "\n", "{}\n"])
def test_what_is_no_journal_is_named_with_its_line(tmp_path: Path, text: str) -> None:
    journal = tmp_path / "journal.jsonl"
    journal.write_text(text)
    with pytest.raises(InputError, match="not a journal of gains: line 1"):
        Journal(journal).unfinished()


def test_a_line_that_stays_broken_is_no_riddle(line: Line, tmp_path: Path) -> None:
    line.times = 1000
    journal = tmp_path / "journal.jsonl"
    with pytest.raises(LinkError, match="may hold old, new or mixed gains"):
        hand_over(line.rig(), NEW, journal)
    assert steps(journal) == ["read", "writing", "restoring"]
    line.times = 0
    old = Journal(journal).unfinished()
    assert old == OLD
    restore(line.rig(), old, journal)
    assert line.gains == OLD
    assert Journal(journal).unfinished() is None


def test_a_line_that_breaks_during_the_trial_takes_the_gains_back(line: Line, tmp_path: Path) -> None:
    config = load_config(ROOT / "configs" / "servo_sim.toml")
    rig = line.rig()

    def try_out(held: PIDController, gains: TrialGains | None) -> Verification:
        assert gains is not None
        writer = RecordingWriter(tmp_path / "trial.csv", ("t", "u", "y"))
        with ControlLoop(rig=rig, envelope=envelope_of(config), writer=writer) as loop:
            while True:
                if loop.tick.k == 3:
                    loop.restore = gains.take_out
                    loop.hold_while(gains.put_in)
                    assert line.gains == NEW
                if loop.tick.k == 5:
                    line.relay.tamper = lambda frame, direction: ()
                    line.device.on_change = healed
                loop.step(loop.nearest(0.1))

    def healed(change: Any) -> None:  # the device's dead-man has acted; the cable is plugged in again
        line.relay.tamper = line.tamper

    with pytest.raises(LinkError, match=r"broken off .*the old gains"):
        deploy(rig, NEW, tmp_path / "journal.jsonl", agree=agreed, try_out=try_out)
    line.relay.tamper = line.tamper
    old = Journal(tmp_path / "journal.jsonl").unfinished()
    if old is not None:  # the line was still dead when the gains should have gone back
        restore(line.rig(), old, tmp_path / "journal.jsonl")
    assert line.gains == OLD
    assert line.device.output in (U_SAFE, DEVICE_SAFE)


CHILD = """
import sys
from pathlib import Path
from autotune.controller import PIDController
from autotune.pipeline.deployment import hand_over
from tests.autotune.test_pipeline_deployment import APART, NEW
from tests.drivers.bench import rig_of, tcp_settings

hand_over(rig_of(tcp_settings(int(sys.argv[1]), APART, timeout_s=30.0)), NEW, Path(sys.argv[2]))
"""


@pytest.fixture
def half_written(line: Line, tmp_path: Path) -> Path:
    """Return the journal of a process that was killed between the writes of K and Ti."""
    journal = tmp_path / "journal.jsonl"
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(line.relay.port), str(journal)], cwd=ROOT)
    line.times, line.seen = 1, child.kill
    assert child.wait(60.0) == -signal.SIGKILL
    line.seen = None
    assert line.gains == MIXED
    return journal


def config_file(line: Line, folder: Path) -> Path:
    """Write a configuration of the device behind the relay, its limits in order."""
    servo = load_config(ROOT / "configs" / "servo_sim.toml")
    config = Config.model_validate(servo.model_dump() | {"rig": tcp_settings(line.relay.port, APART).model_dump()})
    path = folder / "rig.toml"
    path.write_text(tomli_w.dumps(config.model_dump(mode="json", exclude_none=True)))
    (folder / "new.toml").write_text('kind = "pi"\nK = 0.75\nTi_s = 4.0\n')
    return path


def typed(*arguments: str | Path, answers: str) -> tuple[int, str]:
    """Run the command for a person at a terminal who types the answers; return its exit status and what it said."""
    keyboard, terminal = pty.openpty()
    os.write(keyboard, answers.encode())
    command = [sys.executable, "-m", "autotune.cli", *map(str, arguments)]
    done = subprocess.run(command, stdin=terminal, capture_output=True, text=True, check=False)
    os.close(keyboard)
    os.close(terminal)
    return done.returncode, done.stdout + done.stderr


def test_the_next_deploy_finds_half_written_gains_and_restores_the_old_ones(
    line: Line, half_written: Path, tmp_path: Path
) -> None:
    config = config_file(line, tmp_path)
    call = ("deploy", config, "--controller", tmp_path / "new.toml", "--no-verify", "--out", tmp_path)
    status, said = typed(*call, answers="y\nn\n")
    assert "interrupted" in said
    assert "The old gains are in place again." in said
    assert (status, line.gains) == (2, OLD)  # restored, and the new ones refused
    assert Journal(half_written).unfinished() is None


def test_a_run_that_is_gone_on_with_does_not_take_half_written_gains_for_the_old_ones(
    line: Line, half_written: Path
) -> None:
    assert hand_over(line.rig(), NEW, half_written) == OLD
    assert line.gains == NEW
    assert steps(half_written)[2:] == ["restoring", "restored", "read", "writing", "written and read back"]


def test_a_second_deploy_replaces_nothing(line: Line, tmp_path: Path) -> None:
    config = config_file(line, tmp_path)
    call = ["deploy", str(config), "--controller", str(tmp_path / "new.toml"), "--no-verify", "--yes"]
    folder = tmp_path / "rig-gains"
    assert CliRunner().invoke(app, call).exit_code == 0
    (folder / "deploy-2.html").write_text("somebody's notes")
    first = {name: (folder / name).read_bytes() for name in ("deploy.json", "deploy.html", "deploy-2.html")}
    assert CliRunner().invoke(app, call).exit_code == 0
    assert {name: (folder / name).read_bytes() for name in first} == first
    assert json.loads((folder / "deploy-3.json").read_text())["old"]["K"] == NEW.K
    assert (folder / "deploy-3.html").exists()


def test_old_and_new_gains_are_shown_and_an_answer_of_no_writes_nothing(line: Line, tmp_path: Path) -> None:
    config = config_file(line, tmp_path)
    call = ("deploy", config, "--controller", tmp_path / "new.toml", "--no-verify", "--form", "parallel")
    status, said = typed(*call, answers="n\n")
    assert (status, line.gains) == (2, OLD)
    row = next(text for text in said.splitlines() if "Ki_per_s" in text)
    assert [float(cell) for cell in row.split("│")[2:4]] == [0.75, 0.1875]  # K / Ti, old and new
    assert not (tmp_path / "rig-gains" / "journal.jsonl").exists()


@pytest.mark.parametrize(
    ("gains", "said"),
    [
        ("K = 1e15\nTi_s = 4.0", "moves the command through its whole range"),
        ("K = -0.75\nTi_s = 4.0", "have the other sign than the K = 1.5 that the rig holds"),
    ],
)
def test_gains_that_no_such_rig_runs_with_are_not_written_even_unverified(
    line: Line, tmp_path: Path, gains: str, said: str
) -> None:
    config = config_file(line, tmp_path)
    (tmp_path / "new.toml").write_text(f'kind = "pi"\n{gains}\n')
    call = ["deploy", str(config), "--controller", str(tmp_path / "new.toml"), "--no-verify", "--yes"]
    error = CliRunner().invoke(app, call).exception
    assert isinstance(error, InputError)
    assert said in str(error)
    assert line.gains == OLD


def test_gains_are_compared_with_the_measured_plant_even_unverified(line: Line, tmp_path: Path) -> None:
    """Thirty times the gain: within the rig's ranges, and unstable on its points."""
    config = config_file(line, tmp_path)
    w = np.array([1.0, 2.0, 4.0, 8.0])
    plant = 2.0 * np.exp(-0.2j * w) / (1j * w + 1.0)
    points = [
        FrequencyPoint(omega_rad_s=a, response=b, covariance=((1e-6, 0.0), (0.0, 1e-6)))
        for a, b in zip(w, plant, strict=True)
    ]
    (tmp_path / "p.json").write_text(json.dumps({"points": points_to_json(points)}))
    (tmp_path / "new.toml").write_text('kind = "pi"\nK = 22.0\nTi_s = 4.0\n')
    call = ["deploy", str(config), "--controller", str(tmp_path / "new.toml"), "--no-verify", "--yes"]
    error = CliRunner().invoke(app, [*call, "--points", str(tmp_path / "p.json")]).exception
    assert isinstance(error, DesignError)
    assert "make no stable loop" in str(error)
    assert line.gains == OLD


def test_without_a_person_and_without_yes_nothing_is_done(line: Line, tmp_path: Path) -> None:
    config = config_file(line, tmp_path)
    call = ["deploy", str(config), "--controller", str(tmp_path / "new.toml")]
    for options, remedy in ((["--no-verify"], "--yes"), ([], "--points")):
        error = CliRunner().invoke(app, [*call, *options]).exception
        assert isinstance(error, InputError)
        assert remedy in error.remedy
    assert line.gains == OLD


def test_a_journal_that_cannot_be_written_keeps_the_old_gains(line: Line, tmp_path: Path) -> None:
    (tmp_path / "journal.jsonl").symlink_to("/dev/full")
    with pytest.raises(ExperimentStopped, match="the journal cannot be written"):
        deploy(line.rig(), NEW, tmp_path / "journal.jsonl", agree=agreed, try_out=None)
    assert line.gains == OLD


def test_what_is_no_journal_is_refused(tmp_path: Path) -> None:
    (tmp_path / "journal.jsonl").write_text('{"gains": "writing"}\n')
    with pytest.raises(InputError, match="not a journal"):
        Journal(tmp_path / "journal.jsonl").unfinished()


def test_a_line_of_the_journal_that_was_cut_off_was_not_acted_upon(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal.jsonl")
    rig = SimulatedRig(make_plant("servo", seed=1), u_safe=0.0, controller=PIDController(K=1.0, Ti_s=math.inf))
    hand_over(rig, None, journal.path)
    with journal.path.open("a") as file:
        file.write('{"gains": "writ')
    assert journal.unfinished() is None
    assert replace(rig.read_gains(), K=2.0).Ti_s == math.inf


def patient(line: Line) -> Any:
    """Return the rig on a line that is not cut, however late the computer is."""
    return rig_of(tcp_settings(line.relay.port, APART, timeout_s=20.0))


def audit_of(folder: Path) -> AuditLog:
    return audit_log(load_config(ROOT / "configs" / "servo_sim.toml"), folder, "deploy")


def lines(log: AuditLog) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.path.read_text().splitlines()]


def test_the_audit_log_says_who_changed_what_when_from_where_and_why(line: Line, tmp_path: Path) -> None:
    log = audit_of(tmp_path)
    before = datetime.now(UTC)
    rig = patient(line)
    deploy(rig, NEW, tmp_path / "journal.jsonl", agree=agreed, try_out=verified(rig, True), audit=log)
    held = PIDController(K=NEW.K, Ti_s=NEW.Ti_s)
    deploy(rig, OLD, tmp_path / "journal.jsonl", agree=lambda *_: None, try_out=verified(rig, False), audit=log)
    found = lines(log)
    assert [one["verdict"] for one in found] == [
        "writing", "written and read back, on trial", "restoring", "restored", "writing", "verified, kept",
        "writing", "written and read back, on trial", "restoring", "restored", "not accepted, the old gains stay",
    ]  # fmt: skip
    for one in found:
        assert (one["who"], one["host"], one["command"]) == (user(), socket.gethostname(), "deploy")
        assert before <= datetime.fromisoformat(one["at"]) <= datetime.now(UTC)
        assert datetime.fromisoformat(one["at"]).utcoffset() == timedelta(0)
        assert one["configuration"] == log.configuration
    assert (found[5]["old"]["K"], found[5]["new"]["K"]) == (OLD.K, held.K)
    assert (found[-2]["old"]["K"], found[-2]["new"]["K"]) == (held.K, held.K)  # the old gains again


def asking(path: Path, table: str) -> list[str]:
    """Have a configuration ask for a second person; return a call that hands gains over."""
    path.write_text(path.read_text() + f"\n{table}\n")
    return ["deploy", str(path), "--controller", str(path.with_name("new.toml")), "--no-verify", "--yes"]


@pytest.mark.parametrize(
    ("table", "given", "said"),
    [
        ("[approval]", [], "the hand-over needs a second person's name"),
        ("[approval]", ["--approved-by", "Ada"], "the hand-over needs a second person's reason"),
        ("[approval]", ["--approved-by", user(), "--reason", "x"], "asks for the hand-over and cannot approve it"),
        ('[approval]\napprovers = ["Grace"]', ["--approved-by", "Ada", "--reason", "x"], "none of those who may"),
    ],
)
def test_without_a_second_person_nothing_is_written(
    line: Line, tmp_path: Path, table: str, given: list[str], said: str
) -> None:
    call = asking(config_file(line, tmp_path), table)
    error = CliRunner().invoke(app, [*call, *given]).exception
    assert isinstance(error, InputError)
    assert said in str(error)
    assert line.gains == OLD


def test_a_second_persons_name_and_reason_are_in_the_audit_log_with_the_gains(line: Line, tmp_path: Path) -> None:
    call = asking(config_file(line, tmp_path), '[approval]\napprovers = ["Ada"]')
    assert CliRunner().invoke(app, [*call, "--approved-by", "ada", "--reason", "seen at the rig"]).exit_code == 0
    assert line.gains == NEW
    lines = [json.loads(text) for text in (tmp_path / "rig-gains" / "audit.jsonl").read_text().splitlines()]
    assert all(one["approval"] == {"name": "ada", "reason": "seen at the rig"} for one in lines)
    assert (lines[-1]["old"]["K"], lines[-1]["new"]["K"]) == (OLD.K, NEW.K)


def test_one_changed_key_is_another_configuration(tmp_path: Path) -> None:
    config = load_config(ROOT / "configs" / "servo_sim.toml")
    swing = config.limits.model_copy(update={"swing": 0.4})
    changed = config.model_copy(update={"limits": swing})
    assert audit_log(config, tmp_path, "run").configuration != audit_log(changed, tmp_path, "run").configuration
    assert audit_log(config.model_copy(update={"audit_log": "/var/log/rig.jsonl"}), tmp_path, "run").path.is_absolute()


def test_the_audit_log_is_appended_to_by_many_and_never_rewritten(tmp_path: Path) -> None:
    log = audit_of(tmp_path)
    log.path.write_text('{"cut off by a full di')
    with ThreadPoolExecutor(8) as pool:
        for done in [pool.submit(log.note, f"step {k}", old=OLD, new=NEW) for k in range(200)]:
            done.result()
    cut, *rest = log.path.read_text().splitlines()
    assert cut == '{"cut off by a full di'
    assert {json.loads(one)["verdict"] for one in rest if one} == {f"step {k}" for k in range(200)}


def test_no_gains_are_written_that_the_audit_log_cannot_take(line: Line, tmp_path: Path) -> None:
    log = replace(audit_of(tmp_path), path=tmp_path)  # a folder is no file
    with pytest.raises(ExperimentStopped, match="journal cannot be written"):
        deploy(patient(line), NEW, tmp_path / "journal.jsonl", agree=agreed, try_out=None, audit=log)
    assert line.gains == OLD
