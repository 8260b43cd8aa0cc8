"""A device's own controller on trial: what it computes, what is called verified, and how the rig is left."""

from __future__ import annotations

import math
import re
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from autotune.config import Config, load_config
from autotune.config.registers import RegisterMap
from autotune.controller import PIDController
from autotune.errors import AutotuneError, ExperimentStopped, LinkError, NotTaken
from autotune.experiment.judgement import Verification
from autotune.experiment.rig import TrialGains
from autotune.experiment.run import run_experiment
from autotune.experiment.verify import run_verification
from autotune.models import TransferFunction
from autotune.pipeline.deployment import deploy
from autotune.recording import read_recording
from autotune.report.run_page import verification_page
from drivers.gain_rig import GainRegisterRig
from drivers.modbus import ModbusLink
from sim.plant import make_plant
from tests.autotune.experiment.test_verify import CONFIG as BALL
from tests.autotune.experiment.test_verify import FIT as BALL_FIT
from tests.autotune.experiment.test_verify import PI, fitted
from tests.drivers.bench import tcp_settings
from tests.drivers.tcp_relay import run_before_others
from tests.drivers.virtual_device import DirectLink, virtual_rig

#: the ball's, and a register for the load
REGISTERS: dict[str, Any] = {
    "y": {"table": "input", "address": 0, "type": "float32"},
    "u_applied": {"table": "input", "address": 2, "type": "float32"},
    "heartbeat_echo": {"table": "input", "address": 6, "type": "uint16"},
    "in_command": {"table": "input", "address": 7, "type": "uint16"},
    "u": {"address": 0, "type": "float32"},
    "heartbeat": {"address": 2, "type": "uint16"},
    "safe": {"address": 3, "type": "uint16", "scale": 1e-3},
    "enable": {"table": "coil", "address": 0},
    "automatic": {"table": "coil", "address": 1},
    "trial": {"table": "coil", "address": 2},
    "K": {"address": 10, "type": "float32", "word_order": "little"},
    "Ti": {"address": 12, "type": "uint32", "scale": 1e-3},
    "setpoint": {"address": 14, "type": "int16", "scale": 1e-3},
    "load": {"address": 16, "type": "float32"},
}
SAFE = 0.0


def law(K: float = 1.0, Ti: float = 1.0, parallel: bool = False) -> Any:
    """Return a device's law that takes the gains otherwise by these factors, or as a parallel form."""

    def of(held: Mapping[str, float]) -> tuple[float, float, float, float]:
        Ti_s = abs(held["K"]) * held["Ti"] if parallel else Ti * held["Ti"]
        return K * held["K"], Ti_s, held["Td"], held["Tf"]

    return of


def tried(folder: Path, *, without: tuple[str, ...] = (), **device: Any) -> tuple[Verification, Any]:
    """Write the ball's gains into a device, try its own controller on them, and return what was found."""
    registers = {name: given for name, given in REGISTERS.items() if name not in without}
    rig, held = virtual_rig(make_plant("ball", seed=1), registers=registers, **device)
    rig.write_gains(PI)
    return run_verification(rig, BALL, rig.read_gains(), BALL_FIT, folder / "trial.csv", on_device=True), held


def test_the_devices_own_law_is_what_is_verified(tmp_path: Path) -> None:
    found, device = tried(tmp_path)
    assert found.accepted, found.reason
    assert (found.by, found.whose) == ("device", "the device's own law verified")
    assert any(change.cause == "controller" for change in device.history)
    assert found.running_law is not None
    assert found.running_law.is_given
    assert pytest.approx(PI.K, rel=0.1) == found.running_law.K
    assert found.running_law.Ti_s == pytest.approx(PI.Ti_s, rel=0.1)
    assert device.output == SAFE
    assert device.value["load"] == 0.0
    assert device.value["setpoint"] == BALL.operating_point.y  # what the next one in automatic goes to


def cut_off(rig: Any, device: Any, folder: Path) -> list[str]:
    """Try the ball's gains over a line that fails for good once they run; return what the operator was told."""
    told: list[str] = []
    begun = [math.inf]

    def before() -> None:
        if device.value["automatic"]:
            begun[0] = min(begun[0], rig.clock.now())
        if rig.clock.now() > begun[0] + 3.0:
            raise LinkError("no answer", where="line")

    rig._link.before = before
    rig.write_gains(PI)
    with pytest.raises(LinkError, match="Go to the rig"):
        run_verification(
            rig, BALL, PI, BALL_FIT, folder / "trial.csv", on_device=True, on_status=lambda s: told.append(s.message)
        )
    return told


def test_a_trial_that_is_cut_off_ends_at_the_safe_output_and_the_next_host_takes_it_back(tmp_path: Path) -> None:
    rig, device = virtual_rig(make_plant("ball", seed=1), registers=REGISTERS, gains=(-0.01, 6.0), deadman_s=0.5)
    told = cut_off(rig, device, tmp_path)
    assert "steps of the device's own controller" in told
    assert not any("stay at the rig" in message for message in told)
    device.live(rig.clock.now() + 1.0)
    fell = next(change.t_s for change in device.history if change.cause == "dead-man")
    fed = max(change.t_s for change in device.history if change.cause == "controller")
    assert 0.0 <= fell - fed <= 0.5
    assert device.output == SAFE
    device.show("automatic", 1.0)  # by hand, on gains that nobody has verified: a host has to be there
    device.live(rig.clock.now() + 2.0)
    assert device.output == SAFE
    rig._link.before = lambda: None
    rig.open()
    assert rig.former is None  # what ran on trial is nothing to go back to
    rig.write(4.0)
    assert (device.output, device.value["trial"], device.value["automatic"]) == (4.0, 0.0, 0.0)
    rig.make_safe()
    rig.close()


def test_a_device_without_the_flag_regulates_on_and_the_operator_is_told_to_stay(tmp_path: Path) -> None:
    registers = {name: given for name, given in REGISTERS.items() if name != "trial"}
    rig, device = virtual_rig(make_plant("ball", seed=1), registers=registers, gains=(-0.01, 6.0), deadman_s=0.5)
    told = cut_off(rig, device, tmp_path)
    assert any("stay at the rig" in message for message in told)
    device.live(rig.clock.now() + 2.0)
    assert device.value["automatic"] == 1.0
    assert device.output != SAFE


def test_a_host_that_tries_gains_is_another_master_to_whoever_comes(tmp_path: Path) -> None:
    rig, device = virtual_rig(make_plant("ball", seed=1), registers=REGISTERS, gains=(-0.01, 6.0))
    rig.open()
    rig.start_controller(5.0)
    clock = rig.clock
    other = GainRegisterRig(
        DirectLink(device, clock), RegisterMap.model_validate(REGISTERS), u_range=(0.0, 10.0), u_safe=0.0, clock=clock
    )
    sleep = clock.sleep_until

    def sleep_until(t_s: float) -> None:  # the first host lives on meanwhile
        sleep(t_s)
        clock.sleep_until = sleep
        rig.feed()
        clock.sleep_until = sleep_until

    clock.sleep_until = sleep_until
    with pytest.raises(NotTaken, match="another master commands the rig"):
        other.open()
    clock.sleep_until = sleep
    rig.read()
    rig.make_safe()
    rig.close()


def test_without_a_register_for_the_load_the_set_point_comes_back_and_that_is_all(tmp_path: Path) -> None:
    found, _ = tried(tmp_path, without=("load",))
    assert found.accepted, found.reason
    assert not found.test.disturbance.any()
    assert found.test.setpoint[-1] == 0.0 < found.test.setpoint[0]
    (section,) = verification_page("ball", BALL.signals, PI, found).sections
    assert section.text[0] == "Set-point step of 1 V, then back; no load was tried, as none is mapped in [rig]."
    assert "and back on the right" in section.figures[0].caption
    assert [row[0] for row in section.tables[0].rows] == ["overshoot [%]", "rise to 90 % [s]"]


@pytest.mark.parametrize("lacking", ["automatic", "setpoint", "u_applied"])
def test_a_controller_that_the_host_cannot_start_or_see_is_never_called_verified(tmp_path: Path, lacking: str) -> None:
    found, device = tried(tmp_path, without=(lacking, "trial"))
    assert found.accepted
    assert found.whose == f"host's law verified; the device's own law not tried ({lacking} is not mapped)"
    assert not any(change.cause == "controller" for change in device.history)


@pytest.mark.parametrize(
    ("device", "named"),
    [
        ({"on_device": {"K": {"word_order": "big"}}}, "wrong word_order of rig.registers.K"),
        ({"on_device": {"Ti": {"word_order": "little"}}}, "wrong word_order of rig.registers.Ti"),
        ({"law": law(Ti=60.0)}, "times in minutes for seconds"),
        ({"law": law(Ti=1.0 / 60.0)}, "times in seconds for minutes"),
        ({"law": law(K=2.0)}, "percent for engineering units.*K acts (1.9|2)"),
        ({"law": law(K=0.01)}, "percent for engineering units.*K acts 0.01 times"),
        ({"law": law(K=100.0)}, "percent for engineering units.*K acts 100 times"),
        ({"law": law(parallel=True)}, "the parallel form and not the ideal one"),
        ({"law": law(K=-1.0)}, "the wrong sign"),
        ({"on_device": {"setpoint": {"scale": 1e-2}}}, "wrong scale of the set-point: the device holds y at 10 times"),
        ({"on_device": {"setpoint": {"scale": 1e-4}}}, "wrong scale of the set-point: the device holds y at 0.1 times"),
        ({"on_device": {"setpoint": {"byte_order": "little"}}}, "wrong byte_order of rig.registers.setpoint"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_a_device_understands_otherwise_is_named_and_never_kept(
    tmp_path: Path, device: dict[str, Any], named: str
) -> None:
    rig, held = virtual_rig(make_plant("ball", seed=1), registers=REGISTERS, gains=(-0.01, 6.0), **device)
    old = rig.read_gains()

    def trial(held: PIDController, gains: TrialGains | None) -> Verification:
        return run_verification(rig, BALL, held, BALL_FIT, tmp_path / "trial.csv", gains=gains)

    try:
        done = deploy(rig, PI, tmp_path / "journal.jsonl", agree=lambda *_: None, try_out=trial)
    except ExperimentStopped as stopped:
        said = str(stopped)
    else:
        assert done.verification is not None
        assert not done.kept
        said = done.verification.reason
    assert re.search(named, said), said
    assert rig.read_gains() == old
    assert held.output == SAFE


def test_a_controller_that_ran_before_has_its_set_point_again_and_no_load(tmp_path: Path) -> None:
    rig, device = virtual_rig(make_plant("ball", seed=1), registers=REGISTERS, gains=(PI.K, PI.Ti_s))
    for name, value in (("setpoint", 4.5), ("automatic", 1.0)):
        rig._put(name, value)
    found = run_verification(rig, BALL, rig.read_gains(), BALL_FIT, tmp_path / "trial.csv", on_device=True)
    assert found.by == "device"
    assert (device.value["automatic"], device.value["setpoint"], device.value["load"]) == (1.0, 4.5, 0.0)


def regulating(rig: Any, setpoint: float = 5.0) -> None:
    """Leave the device's own controller in automatic at a set-point, the ball afloat there."""
    for name, value in (("setpoint", setpoint), ("automatic", 1.0)):
        rig._put(name, value)
    rig.clock.sleep_until(rig.clock.now() + 60.0)


def afloat(device: Any) -> Any:
    """Return the operating point of a ball that is held where it is."""
    known = {"approach": "hold", "plant_sign": -1, "u_guess": device.plant.u_rest, "u_uncertainty": 0.15}
    return BALL.operating_point.model_copy(update=known)


@pytest.mark.parametrize("setpoint", [5.0, 5.4])
def test_after_a_sweep_the_controller_takes_over_at_its_set_point(tmp_path: Path, setpoint: float) -> None:
    """The sweep ends at an extremum of y, which was .9 V off."""
    rig, device = virtual_rig(
        make_plant("ball", seed=1, noise=0.1, start="afloat"), registers=REGISTERS, gains=(PI.K, PI.Ti_s)
    )
    regulating(rig, setpoint)
    at = afloat(device)
    wanted = BALL.experiment.model_copy(update={"points": 3, "budget_s": 20.0})
    config = BALL.model_copy(update={"operating_point": at, "experiment": wanted})
    result = run_experiment(rig, config, tmp_path / "sweep.csv")
    assert result.output == f"handed back to its own controller: automatic at set-point {setpoint:g}"
    y = read_recording(tmp_path / "sweep.csv").y
    assert np.ptp(y[len(y) // 2 :]) > 2.0  # the sweep's swing
    assert np.mean(y[-6:-1]) == pytest.approx(setpoint, abs=0.25)
    assert device.value["setpoint"] == setpoint


def test_after_a_trial_of_the_hosts_law_the_controller_takes_over_at_its_set_point(tmp_path: Path) -> None:
    rig, device = virtual_rig(
        make_plant("ball", seed=1, noise=0.1, start="afloat"), registers=REGISTERS, gains=(PI.K, PI.Ti_s)
    )
    regulating(rig)
    config = BALL.model_copy(update={"operating_point": afloat(device)})
    found = run_verification(rig, config, PI, BALL_FIT, tmp_path / "trial.csv")
    assert found.accepted, found.reason
    recording = read_recording(tmp_path / "trial.csv")
    assert recording.extra["r"][-2] == 5.0
    assert np.mean(recording.y[-6:-1]) == pytest.approx(5.0, abs=0.25)


# a controller in C that is nobody's own code here: positional form, its plant and its clock its own

LAGS = TransferFunction(num=(1.0,), den=(0.03, 0.4, 1.0), delay_s=0.02)
GAINS = PIDController(K=0.5, Ti_s=0.3)
FLOAT = {"type": "float32"}
PEER: dict[str, Any] = {
    "y": {"table": "input", "address": 0, **FLOAT},
    "u_applied": {"table": "input", "address": 2, **FLOAT},
    "heartbeat_echo": {"table": "input", "address": 4, "type": "uint16"},
    "in_command": {"table": "input", "address": 5},
    "u": {"address": 0, **FLOAT},
    "heartbeat": {"address": 2, "type": "uint16"},
    "safe": {"address": 3, **FLOAT},
    "K": {"address": 10, **FLOAT},
    "Ti": {"address": 12, **FLOAT},
    "setpoint": {"address": 14, **FLOAT},
    "load": {"address": 16, **FLOAT},
    "enable": {"table": "coil", "address": 0},
    "automatic": {"table": "coil", "address": 1},
    "trial": {"table": "coil", "address": 2},
}


@pytest.fixture(scope="session")
def controller_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled_controller(tmp_path_factory.mktemp("controller"))


def compiled_controller(folder: Path) -> Path:
    """Compile the controller in C, and return the program."""
    program = folder / "controller"
    source = Path(__file__).with_name("libmodbus_controller.c")
    command = ["gcc", "-O2", "-Wall", "-Wextra", "-I/usr/include/modbus", "-o", program, source, "-lmodbus", "-lm"]
    subprocess.run(command, check=True)
    return program


@contextmanager
def controller(program: Path, law_name: str) -> Iterator[int]:
    command = [program, law_name]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=run_before_others) as process:
        try:
            assert process.stdout is not None
            yield int(process.stdout.readline().split()[1])
        finally:
            process.kill()


class SteppedClock:
    """The time of a device that goes on only when somebody waits: a computer may be as busy as it likes."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process, self._t_s = process, 0.0

    def now(self) -> float:
        return self._t_s

    def sleep_until(self, t_s: float) -> None:
        if t_s <= self._t_s:
            return
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{t_s:.6f}\n")
        self._process.stdin.flush()
        assert self._process.stdout.readline()
        self._t_s = t_s


@contextmanager
def stepped_controller(program: Path, law_name: str) -> Iterator[tuple[int, SteppedClock]]:
    """Run the controller on the time that its clock gives it; yield its port and that clock."""
    command = [program, law_name, "0", "0.5", "-", "steps"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, preexec_fn=run_before_others) as process:
        try:
            assert process.stdout is not None
            yield int(process.stdout.readline().split()[1]), SteppedClock(process)
        finally:
            process.kill()


def peer_config(port: int, folder: Path) -> Config:
    content: dict[str, Any] = {
        "name": "C controller",
        "rig": tcp_settings(port, RegisterMap.model_validate(PEER), timeout_s=1.0, scan_time_s=0.01).model_dump(
            mode="json", exclude_none=True
        ),
        "signals": {"sample_time_s": 0.04, "u_unit": "V", "y_unit": "V"},
        "limits": {
            "u_min": 0.0, "u_max": 10.0, "u_safe": 4.5, "y_min": 0.2, "y_max": 9.5, "swing": 2.0, "time_s": 120.0,
            "late_s": 1.0,
        },
        "operating_point": {"y": 5.0, "u_guess": 5.0, "u_uncertainty": 1.0, "plant_sign": 1},
        "experiment": {"budget_s": 60.0},
        "design": {"noise_gain": 20.0},
    }  # fmt: skip
    path = folder / "rig.toml"
    path.write_text(tomli_w.dumps(content))
    return load_config(path)


@pytest.mark.system("libmodbus-dev", "gcc")
@pytest.mark.parametrize(
    ("law_name", "named"),
    [
        ("ideal", ""),
        ("swapped", "wrong word_order of rig.registers.K"),
        ("minutes", "times in minutes for seconds"),
        ("percent", "percent for engineering units"),
        ("parallel", "parallel form"),
        ("reversed", "the wrong sign"),
    ],
)
def test_a_controller_in_c_is_verified_or_named(
    controller_program: Path, tmp_path: Path, law_name: str, named: str
) -> None:
    fit = fitted(LAGS, 1.5, 3.0, 5.0, 8.0)
    with stepped_controller(controller_program, law_name) as (port, clock):
        config = peer_config(port, tmp_path)
        rig = GainRegisterRig(
            ModbusLink(config.rig), RegisterMap.model_validate(PEER), u_range=(0.0, 10.0), u_safe=4.5,
            scan_time_s=0.01, clock=clock,
        )  # fmt: skip

        def trial(held: PIDController, gains: TrialGains | None) -> Verification:
            return run_verification(
                rig, config, held, fit, tmp_path / "trial.csv", u_rest=5.0, noise_sd=1e-3, gains=gains
            )

        said = ""
        try:
            done = deploy(rig, GAINS, tmp_path / "journal.jsonl", agree=lambda *_: None, try_out=trial)
        except AutotuneError as stopped:
            said, kept = str(stopped), False
        else:
            assert done.verification is not None
            said, kept = done.verification.reason, done.kept
        assert kept == (named == ""), said
        assert named in said
        assert pytest.approx(GAINS.K if kept else 0.1) == rig.read_gains().K
        rig.close()
