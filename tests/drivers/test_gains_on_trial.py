"""New gains run in a device's own controller only while a host watches their trial, or once they are accepted."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from autotune.config import Config, load_config
from autotune.config.registers import RegisterMap
from autotune.controller import PIDController
from autotune.errors import ExperimentStopped, LinkError, OperatorStop
from autotune.experiment.judgement import Verification
from autotune.experiment.result import Status
from autotune.experiment.rig import TrialGains
from autotune.experiment.verify import run_verification
from autotune.models import TransferFunction
from autotune.pipeline.deployment import Deployment, deploy, restore_interrupted
from autotune.pipeline.journal import Journal
from autotune.recording import read_recording
from sim.modbus_rig import ModbusRig, TcpTransport
from sim.plant import make_plant
from tests.autotune.experiment.test_verify import FIT as BALL_FIT
from tests.autotune.experiment.test_verify import PI, fitted
from tests.drivers.bench import LIMIT_S, register_device, rig_of, tcp_settings
from tests.drivers.bench import REGISTERS as BENCH
from tests.drivers.tcp_relay import Direction, TcpRelay
from tests.drivers.test_own_controller import BALL, REGISTERS, afloat, regulating
from tests.drivers.virtual_device import virtual_rig

ROOT = Path(__file__).resolve().parents[2]
#: what Modbus calls the request, and the address of the set-point on the bench's map
WRITE_REGISTERS, SETPOINT = 16, (20).to_bytes(2, "big")
OLD = (PI.K * 0.8, PI.Ti_s * 1.25)
DEADMAN_S = 0.4


@dataclass
class Scans:
    """What a device's own controller ran on, scan by scan: K and Ti, and whether a trial was on."""

    ran: list[tuple[float, float, bool]] = field(default_factory=list)
    sign: float = 1.0

    def law(self, held: Mapping[str, float]) -> tuple[float, float, float, float]:
        """Note a scan; new gains act with the sign that is asked for."""
        K, Ti = held["K"], held["Ti"]
        self.ran.append((K, Ti, held["trial"] == 1.0))
        is_old = (K, Ti) == pytest.approx(OLD, rel=1e-5)
        return (K if is_old else self.sign * K), Ti, held["Td"], held["Tf"]

    def unwatched(self, gains: tuple[float, float] = OLD) -> list[tuple[float, float, bool]]:
        """Return the scans on other gains without a trial."""
        return [one for one in self.ran if not one[2] and one[:2] != pytest.approx(gains, rel=1e-5)]


@dataclass
class Regulating:
    """A ball that its device's own controller holds on the old gains, and a hand-over of others to it."""

    folder: Path
    scans: Scans = field(default_factory=Scans)
    registers: Mapping[str, Any] = field(default_factory=lambda: REGISTERS)
    on_status: Callable[[Status], None] = lambda status: None

    def __post_init__(self) -> None:
        plant = make_plant("ball", seed=1, noise=0.1, start="afloat")
        self.rig, self.device = virtual_rig(
            plant, registers=self.registers, gains=OLD, law=self.scans.law, deadman_s=DEADMAN_S
        )
        self.rig._scan_s = 0.02
        regulating(self.rig)
        self.journal = self.folder / "journal.jsonl"
        self.before_verdict: list[tuple[float, float, bool]] = []
        self.judged = False

    @property
    def gains(self) -> tuple[float, float]:
        return self.device.value["K"], self.device.value["Ti"]

    def try_out(self, held: PIDController, gains: TrialGains | None) -> Verification:
        config: Config = BALL.model_copy(update={"operating_point": afloat(self.device)})
        found = run_verification(
            self.rig, config, held, BALL_FIT, self.folder / "trial.csv", gains=gains, on_status=self.on_status
        )
        self.rig.clock.sleep_until(self.rig.clock.now() + 2.0)  # what the verdict takes
        self.before_verdict = self.scans.unwatched()
        self.judged = True
        return found

    def deploy(self) -> Deployment:
        return deploy(self.rig, PI, self.journal, agree=lambda *_: None, try_out=self.try_out)

    def steps(self) -> list[str]:
        return [json.loads(line)["gains"] for line in self.journal.read_text().splitlines()]


def test_accepted_gains_regulate_first_under_watch_and_then_for_good(tmp_path: Path) -> None:
    one = Regulating(tmp_path)
    done = one.deploy()
    assert done.kept, done.verification
    assert one.before_verdict == []
    assert any(trial for _, _, trial in one.scans.ran)
    assert one.scans.unwatched() == []
    one.rig.clock.sleep_until(one.rig.clock.now() + 1.0)
    assert one.scans.ran[-1] == (pytest.approx(PI.K, rel=1e-5), PI.Ti_s, False)  # as it ran before, on them
    assert (one.device.value["automatic"], one.device.value["setpoint"]) == (1.0, 5.0)
    assert all(
        gains == pytest.approx(OLD, rel=1e-5) or gains == pytest.approx((PI.K, PI.Ti_s), rel=1e-5)
        for *gains, _ in one.scans.ran
    )  # never on half of them
    assert one.steps() == [
        "read", "writing", "written and read back, on trial", "restoring", "restored", "writing", "verified, kept",
    ]  # fmt: skip


def test_gains_that_are_not_accepted_are_gone_before_the_controller_regulates_again(tmp_path: Path) -> None:
    one = Regulating(tmp_path)
    one.scans.sign = 0.6  # the device understands the new K otherwise
    done = one.deploy()
    assert not done.kept
    one.rig.clock.sleep_until(one.rig.clock.now() + 1.0)
    assert one.scans.unwatched() == []
    assert one.gains == pytest.approx(OLD, rel=1e-5)
    assert one.device.value["automatic"] == 1.0
    assert one.steps()[-3:] == ["restoring", "restored", "not accepted, the old gains stay"]


def test_after_a_limit_the_rig_is_safe_first_and_then_has_its_old_gains(tmp_path: Path) -> None:
    one = Regulating(tmp_path)
    one.scans.sign = -1.0
    with pytest.raises(ExperimentStopped, match="the old gains are in place again"):
        one.deploy()
    written = [(table, address) for table, address, _ in one.rig._link.writes]
    backwards = written[::-1]
    assert backwards.index(("holding", 10)) < backwards.index(("coil", 1))
    assert (one.device.output, one.device.value["automatic"]) == (BALL.limits.u_safe, 0.0)
    assert one.gains == pytest.approx(OLD, rel=1e-5)
    assert one.scans.unwatched() == []


@pytest.mark.parametrize("stop", [OperatorStop, ZeroDivisionError])
def test_old_gains_regulate_again_after_ctrl_c_and_nothing_does_after_a_defect(
    tmp_path: Path, stop: type[BaseException]
) -> None:
    def on_status(status: Status) -> None:
        if "device's own controller" in status.message:
            if stop is ZeroDivisionError:
                raise stop
            signal.raise_signal(signal.SIGINT)

    one = Regulating(tmp_path, on_status=on_status)
    with pytest.raises(stop) as caught:
        one.deploy()
    assert "the old gains are in place again" in str(caught.value) + "".join(getattr(caught.value, "__notes__", []))
    one.rig.clock.sleep_until(one.rig.clock.now() + 1.0)
    assert one.scans.unwatched() == []
    assert one.gains == pytest.approx(OLD, rel=1e-5)
    assert one.device.value["automatic"] == (1.0 if stop is OperatorStop else 0.0)
    assert Journal(one.journal).unfinished() is None


def test_a_controller_that_the_host_cannot_start_gets_gains_only_once_the_hosts_law_is_accepted(tmp_path: Path) -> None:
    one = Regulating(tmp_path, registers={name: at for name, at in REGISTERS.items() if name != "u_applied"})
    done = one.deploy()
    assert done.kept
    assert one.before_verdict == []
    assert one.gains == pytest.approx((PI.K, PI.Ti_s), rel=1e-5)
    assert one.steps() == ["read", "writing", "host's law verified; the device's own law not tried"]


def test_a_dead_man_that_acts_while_accepted_gains_are_written_keeps_none(tmp_path: Path) -> None:
    one = Regulating(tmp_path)
    write, clock = one.rig.write_gains, one.rig.clock

    def write_gains(controller: PIDController) -> None:
        write(controller)
        if one.judged and pytest.approx(OLD[0], rel=1e-5) != controller.K:
            clock.sleep_until(clock.now() + 2.0 * DEADMAN_S)

    one.rig.write_gains = write_gains
    with pytest.raises(LinkError, match=r"the device took the actuator back.*the old gains are in place again"):
        one.deploy()
    assert one.gains == pytest.approx(OLD, rel=1e-5)
    assert (one.device.output, one.device.value["automatic"]) == (BALL.limits.u_safe, 0.0)


def test_writes_that_take_longer_than_the_dead_man_end_nothing_and_are_a_gap_in_the_rows(tmp_path: Path) -> None:
    apart = REGISTERS | {"Ti": REGISTERS["Ti"] | {"address": 40}}  # two requests where K and Ti lie together in one
    one = Regulating(tmp_path, registers=apart)
    clock, link = one.rig.clock, one.rig._link
    slow_s = 0.07

    class Stop(Exception):  # noqa: N818 - what is under test is over
        pass

    def on_status(status: Status) -> None:
        if "device's own controller" in status.message:
            link.before = lambda: None
            raise Stop

    one.on_status = on_status
    write = one.rig.write_gains

    def write_gains(controller: PIDController) -> None:
        link.before = lambda: clock.sleep_until(clock.now() + slow_s)
        write(controller)
        link.before = lambda: None

    one.rig.write_gains = write_gains
    with pytest.raises(Stop):
        one.deploy()
    assert not any(change.cause == "dead-man" for change in one.device.history)
    recording = read_recording(tmp_path / "trial.csv")
    assert np.diff(recording.t).max() > DEADMAN_S
    assert recording.metadata["timing"]["missed_samples"] == 0


SERVO = TransferFunction(num=(2.0,), den=(8e-7, 5.74e-4, 0.087, 1.0, 0.0))
SERVED = RegisterMap.model_validate(
    BENCH.model_dump(exclude_none=True) | {"trial": {"table": "coil", "address": 19, "type": "bit"}}
)
NEW = PIDController(K=3.0, Ti_s=1.0)
CHILD = """
import sys
from pathlib import Path
from tests.drivers.test_gains_on_trial import hand_over_servo
hand_over_servo(int(sys.argv[1]), Path(sys.argv[2]))
"""


def hand_over_servo(port: int, folder: Path) -> None:
    """Hand gains to a servo's controller over TCP."""
    servo = load_config(ROOT / "configs" / "servo_sim.toml")
    config = servo.model_copy(
        update={
            "signals": servo.signals.model_copy(update={"sample_time_s": 0.02}),
            "limits": servo.limits.model_copy(update={"late_s": 2.0}),
        }
    )
    rig: Any = rig_of(tcp_settings(port, SERVED, timeout_s=2.0))
    fit = fitted(SERVO, 2.0, 4.0, 6.0, 8.0)

    def try_out(held: PIDController, gains: TrialGains | None) -> Verification:
        return run_verification(rig, config, held, fit, folder / "trial.csv", u_rest=0.0, noise_sd=2e-3, gains=gains)

    deploy(rig, NEW, folder / "journal.jsonl", agree=lambda *_: None, try_out=try_out)


def test_a_host_killed_between_the_gains_and_their_trial_leaves_them_unused_and_the_way_back(tmp_path: Path) -> None:
    scans = Scans()
    device = register_device(SERVED, law=scans.law)
    old = device.value["K"], device.value["Ti"]
    fell = threading.Event()
    device.on_change = lambda change: fell.set() if change.cause == "dead-man" else None
    device.show("automatic", 1.0)
    with ModbusRig(device, TcpTransport()) as server, TcpRelay(server.port) as line:
        child = subprocess.Popen([sys.executable, "-c", CHILD, str(line.port), str(tmp_path)], cwd=ROOT)

        def kill(frame: bytes, direction: Direction) -> Sequence[tuple[float, bytes]]:
            is_setpoint = direction == "to device" and (frame[7], frame[8:10]) == (WRITE_REGISTERS, SETPOINT)
            if is_setpoint and device.value["K"] == NEW.K:
                child.kill()
                return ()
            return ((0.0, frame),)

        line.tamper = kill
        assert child.wait(120.0) == -signal.SIGKILL
        assert fell.wait(LIMIT_S)
        assert scans.ran  # it regulated before
        assert (device.value["K"], device.value["automatic"]) == (NEW.K, 0.0)
        assert scans.unwatched(old) == []
        journal = tmp_path / "journal.jsonl"
        assert json.loads(journal.read_text().splitlines()[-1])["gains"] == "written and read back, on trial"
        restore_interrupted(rig_of(tcp_settings(line.port, SERVED, timeout_s=2.0)), journal)
        assert (device.value["K"], device.value["Ti"]) == old
