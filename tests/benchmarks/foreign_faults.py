"""Faults of a controller in C that is not the project's own code: is each safe, named, and never called verified?

The device (``tests/drivers/libmodbus_controller.c``: its own plant, clock and positional PI, on libmodbus) understands
the gains otherwise, or another master writes to it, or the line to it fails, while a hand-over tries them. A line says
whether they were kept, which K the device holds afterwards, what it puts out when the host has gone, and what was said.
Then the fault campaign's faults of a TCP line, a second master, a device that is busy and has no dead-man, and a host's
process that is stopped, killed or out of disk, each in a short relay session: a line says how long after its last
command the device was at its safe output, by its own log.
``FAULTS=minutes`` runs those whose name has the pattern in it, ``MOMENTS=20`` strikes at so many moments of a session.
"""

from __future__ import annotations

import math
import os
import re
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pyModbusTCP.client import ModbusClient

from autotune.controller import PIDController
from autotune.errors import AutotuneError
from autotune.experiment.judgement import Verification
from autotune.experiment.rig import TrialGains
from autotune.experiment.verify import run_verification
from autotune.pipeline.deployment import deploy
from drivers import open_rig
from tests.autotune.experiment.test_verify import fitted
from tests.drivers import campaign
from tests.drivers.foreign_line import controller_line, faults_on_controller
from tests.drivers.lines import Line
from tests.drivers.signals import SIGNALS, is_right, strike_process
from tests.drivers.tcp_relay import Direction, Tamper, TcpRelay, refuses, unharmed
from tests.drivers.test_own_controller import GAINS, LAGS, compiled_controller, controller, peer_config

#: moment of a fault on the line [s]: the host is bringing the rig to its operating point, and commands it
MOMENT_S = 8.0
#: within which the device's own law has begun [s]
TRIAL_S = 60.0
SAFE_U = 4.5
OLD_K = 0.1
#: after which the device takes its own safe output, and a little [s]
DEADMAN_S = 1.0


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a hand-over: whether the new gains were kept, what was said, K and output of the device."""

    kept: bool
    said: str
    K: float
    output: float


@dataclass(frozen=True)
class Fault:
    """A fault: its name, how the device understands its gains, what has to be said, and what happens on the line."""

    name: str
    law: str
    named: str
    kept: bool = False
    strike: Callable[[TcpRelay], None] | None = None

    def is_right(self, outcome: Outcome) -> bool:
        """Return whether it was named, the device is at its safe output, and its gains are said as they are."""
        holds_new = abs(outcome.K - GAINS.K) < 1e-6
        told = outcome.kept or abs(outcome.K - OLD_K) < 1e-6 or "may hold old, new or mixed gains" in outcome.said
        safe = abs(outcome.output - SAFE_U) < 1e-3
        return (
            bool(re.search(self.named, outcome.said))
            and outcome.kept == self.kept
            and safe
            and (holds_new if self.kept else told)
        )


def _reset(line: TcpRelay) -> None:
    line.reset()


def _for_a_while(tamper: Tamper, seconds: float) -> Callable[[TcpRelay], None]:
    def strike(line: TcpRelay) -> None:
        line.tamper = tamper
        if math.isfinite(seconds):
            time.sleep(seconds)
            line.tamper = unharmed

    return strike


@contextmanager
def _own_law(line: TcpRelay) -> Iterator[ModbusClient]:
    """Yield another master a second after the device's own law has begun."""
    other = ModbusClient(host="127.0.0.1", port=line.port, auto_open=True)
    until_s = time.monotonic() + TRIAL_S
    while other.read_coils(1, 1) != [True] and time.monotonic() < until_s:
        time.sleep(0.1)
    time.sleep(1.0)
    yield other
    other.close()


def _of_another_master(line: TcpRelay, *, address: int, value: float | bool) -> None:
    """Write a register, or a coil where the value is a yes or no, while the device's own law runs."""
    with _own_law(line) as other:
        if isinstance(value, bool):
            assert other.write_single_coil(address, value)
        else:
            assert other.write_multiple_registers(address, list(struct.unpack(">2H", struct.pack(">f", value))))


def _while_it_regulates(tamper: Tamper, line: TcpRelay) -> None:
    with _own_law(line):
        line.tamper = tamper


def _silent(frame: bytes, direction: Direction) -> Sequence[tuple[float, bytes]]:
    return ()


def _late(frame: bytes, direction: Direction) -> Sequence[tuple[float, bytes]]:
    return ((1.3, frame),) if direction == "to host" else ((0.0, frame),)


FAULTS = (
    Fault("none", "ideal", "behaves as predicted", kept=True),
    Fault("wrong word order", "swapped", "wrong word_order of rig.registers.K"),
    Fault("minutes for seconds", "minutes", "times in minutes for seconds"),
    Fault("percent", "percent", "percent for engineering units"),
    Fault("parallel form", "parallel", "parallel form"),
    Fault("wrong sign", "reversed", "the wrong sign"),
    Fault("set-point ten times", "tenfold", "wrong scale of the set-point: the device holds y at 10 times"),
    Fault(
        "set-point of another master",
        "ideal",
        "another master writes setpoint",
        strike=partial(_of_another_master, address=14, value=5.2),
    ),
    Fault(
        "another master ends automatic",
        "ideal",
        "another master writes automatic",
        strike=partial(_of_another_master, address=1, value=False),
    ),
    Fault(
        "gains of another master",
        "ideal",
        "the rig holds K = 0.51",
        strike=partial(_of_another_master, address=10, value=0.51),
    ),
    Fault("connection reset", "ideal", "behaves as predicted", kept=True, strike=_reset),
    Fault("busy for .35 s", "ideal", "behaves as predicted", kept=True, strike=_for_a_while(refuses(6), 0.35)),
    Fault("silent for .1 s", "ideal", "behaves as predicted", kept=True, strike=_for_a_while(_silent, 0.1)),
    Fault("answers too late for good", "ideal", "no answer|link too slow", strike=_for_a_while(_late, math.inf)),
    Fault("silent for good", "ideal", "no answer", strike=_for_a_while(_silent, math.inf)),
    Fault("fails for good", "ideal", "failed to do it", strike=_for_a_while(refuses(4), math.inf)),
    Fault("too late on trial", "ideal", "no answer|link too slow", strike=partial(_while_it_regulates, _late)),
    Fault("silent on trial", "ideal", "no answer", strike=partial(_while_it_regulates, _silent)),
    Fault("fails on trial", "ideal", "failed to do it", strike=partial(_while_it_regulates, refuses(4))),
)


def run_fault(fault: Fault, program: Path, folder: Path) -> Outcome:
    """Hand gains over to the device, with the fault in the middle of their trial."""
    fit = fitted(LAGS, 1.5, 3.0, 5.0, 8.0)
    with controller(program, fault.law) as port, TcpRelay(port) as line:
        config = peer_config(line.port, folder)
        # shorter than the device's dead-man, as on any rig that is to ride through a lost answer
        config = config.model_copy(update={"rig": config.rig.model_copy(update={"timeout_s": 0.2})})
        rig: Any = open_rig(config.rig, u_range=(0.0, 10.0), u_safe=SAFE_U)
        striker = threading.Timer(MOMENT_S, fault.strike, (line,)) if fault.strike is not None else None

        def trial(held: PIDController, gains: TrialGains | None) -> Verification:
            if striker is not None:
                striker.start()
            return run_verification(
                rig, config, held, fit, folder / "trial.csv", u_rest=5.0, noise_sd=1e-3, gains=gains
            )

        kept = False
        try:
            done = deploy(rig, GAINS, folder / "journal.jsonl", agree=lambda *_: None, try_out=trial)
            assert done.verification is not None
            said, kept = done.verification.reason, done.kept
        except AutotuneError as error:
            said = str(error)
        finally:
            rig.close()
            if striker is not None:
                striker.join()
        time.sleep(DEADMAN_S)
        return Outcome(kept=kept, said=said, K=_float(port, "holding", 10), output=_float(port, "input", 2))


def _float(port: int, table: str, address: int) -> float:
    """Return a float of the device, by another library and past the harmed line."""
    client = ModbusClient(host="127.0.0.1", port=port, timeout=2.0)
    words = (client.read_input_registers if table == "input" else client.read_holding_registers)(address, 2)
    client.close()
    return float(struct.unpack(">f", struct.pack(">2H", *words))[0])


def trials(program: Path, place: Path) -> list[bool]:
    """Print a line for each fault of a trial; return which were as they should be."""
    right = []
    for fault in FAULTS:
        if not re.search(os.environ.get("FAULTS", ""), fault.name):
            continue
        folder = place / fault.name.replace(" ", "_")
        folder.mkdir()
        outcome = run_fault(fault, program, folder)
        right.append(fault.is_right(outcome))
        print(
            f"{'right' if right[-1] else 'WRONG'}  {fault.name}: {'kept' if outcome.kept else 'not kept'},"
            f" K = {outcome.K:.3g}, output {outcome.output:.3g}: {outcome.said[:220]}",
            flush=True,
        )
    return right


def sessions(program: Path, place: Path) -> list[bool]:
    """Print a line for each fault of a session, of its worst moment; return which were as they should be."""
    right = []
    for fault in faults_on_controller(program, place):
        if not re.search(os.environ.get("FAULTS", ""), fault.name):
            continue
        outcomes = [campaign.run_fault(fault, seed) for seed in range(int(os.environ.get("MOMENTS", "4")))]
        right.append(_tell(fault.name, outcomes, partial(_ends_so, fault.ends)))
    return right


def _ends_so(ends: Sequence[str], outcome: campaign.Outcome) -> bool:
    return outcome.is_good and any(re.search(end, outcome.ended) for end in ends)


def processes(program: Path, place: Path) -> list[bool]:
    """Print a line for each way in which the host's process ends or its disk is full; return which were right."""
    right = []

    def line(seed: int) -> AbstractContextManager[Line]:
        return controller_line(program, Path(tempfile.mkdtemp(dir=place)), seed)

    for number, _, _ in SIGNALS:
        name = f"process: {number.name if number else 'disk full'}"
        if not re.search(os.environ.get("FAULTS", ""), name):
            continue
        outcomes = [strike_process(number, seed, line) for seed in range(int(os.environ.get("MOMENTS", "4")))]
        right.append(_tell(name, outcomes, partial(is_right, number)))
    return right


def _tell(name: str, outcomes: Sequence[campaign.Outcome], is_as_it_should: Callable[[campaign.Outcome], bool]) -> bool:
    """Print the line of a fault, of its worst moment; return whether all were as they should be."""
    wrong = [one for one in outcomes if not is_as_it_should(one)]
    print(
        f"{'WRONG' if wrong else 'right'}  {name}: {len(outcomes) - len(wrong)} of {len(outcomes)} moments,"
        f" safe {max(one.safe_after_s for one in outcomes):.3f} s after the last command at most,"
        f" {sum(one.beyond_limits for one in outcomes)} commands beyond limits,"
        f" {sum(one.bad_samples for one in outcomes)} samples nobody measured: {(wrong or outcomes)[-1].ended[:120]}",
        flush=True,
    )
    return not wrong


def main() -> None:
    """Print a line for each fault, and how many were as they should be."""
    with tempfile.TemporaryDirectory() as place:
        program = compiled_controller(Path(place))
        right = trials(program, Path(place)) + sessions(program, Path(place)) + processes(program, Path(place))
    print(f"safe, named and not called verified: {sum(right)} of {len(right)}")


if __name__ == "__main__":
    main()
