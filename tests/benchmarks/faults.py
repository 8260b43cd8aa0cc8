"""The fault campaign: every fault at random moments, and what the rig's own side says of it.

A line of the table counts sessions. *safe* is the longest device time from the last command that was taken to the safe
output, against the dead-man time; *commands* are outputs outside the limits, *samples* recorded values that nobody
measured or that were measured longer ago than an answer may take, *ends* those with the wrong exit status or cause. A
session that a busy computer ends before the fault is begun again.
``FAULT_MOMENTS=50`` strikes at fifty moments each (about an hour); four by default. ``FAULTS=serial`` runs those whose
name has the pattern in it.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import track
from rich.table import Table

from autotune.config import load_config
from autotune.errors import AutotuneError
from autotune.experiment.run import run_experiment
from autotune.recording import read_recording
from sim.plant import make_plant
from tests.drivers.bench import DEADMAN_S
from tests.drivers.campaign import FAULTS, Outcome, run_fault
from tests.drivers.ctrl_c import STATES, stop_in
from tests.drivers.plant_campaign import PLANT_FAULTS as PLANT_CAMPAIGN
from tests.drivers.plant_campaign import run_plant_fault
from tests.drivers.signals import SIGNALS, is_right, strike_process
from tests.sim.imperfections import Fault as PlantFault
from tests.sim.imperfections import FaultyPlant, FaultyRig

CONFIG = Path(__file__).parents[2] / "configs" / "ball_sim.toml"

#: fault of the plant, level, the ends that are right for it; on the ball, in virtual time, through the whole sweep
PLANT_FAULTS = (
    ("frozen sensor", 0.0, ("stale sensor", "not oscillat", "no oscillation", "limit reached")),
    ("not a number", 0.0, ("not a number",)),
    ("spikes", 9.9, ("completed", "garbled", "jumps", "limit reached")),
    ("sensor at full scale", 10.0, ("stale sensor", "limit reached", "jumps", "out of range")),
    ("stuck actuator", 0.0, ("does not follow", "limit reached", "no oscillation")),
    ("inverted actuator", 5.0, ("wrong sign", "limit reached", "does not follow", "no oscillation")),
    ("cut link", 0.0, ("link",)),
)


def plant_fault(kind: str, level: float, seed: int) -> Outcome:
    """Run the ball's sweep in virtual time with a fault from a drawn moment on."""
    config = load_config(CONFIG)
    moment_s = 3.0 + (seed * 7.3) % 50.0
    plant = FaultyPlant(make_plant("ball", seed=seed), [PlantFault(kind=kind, start_s=moment_s, value=level)])  # type: ignore[arg-type]
    rig = _WatchedRig(plant, u_safe=config.limits.u_safe)
    error: AutotuneError | None = None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sweep.csv"
        try:
            run_experiment(rig, config, path)
        except AutotuneError as caught:
            error = caught
        rows = len(read_recording(path))
    limits = config.limits
    return Outcome(
        ended="completed" if error is None else str(error),
        exit_status=0 if error is None else error.exit_status,
        safe_after_s=0.0 if rig.command == limits.u_safe else float("inf"),
        beyond_limits=sum(not limits.u_min <= u <= limits.u_max for u in rig.commands),
        bad_samples=0,
        rows=rows,
    )


class _WatchedRig(FaultyRig):
    """A simulated rig that keeps the commands it got."""

    commands: list[float]

    def open(self) -> None:
        """Take command."""
        self.commands = []
        super().open()

    def write(self, u: float) -> None:
        """Hold ``u`` [u unit] from now on."""
        self.commands.append(u)
        super().write(u)


def main() -> None:
    """Print the table."""
    moments = int(os.environ.get("FAULT_MOMENTS", "4"))
    table = Table(
        *("fault", "sessions", "completed", "safe [s]", "commands", "samples", "ends", "rows"),
        title=f"Fault campaign: {moments} moments each, dead-man {DEADMAN_S:g} s",
    )
    wrong: list[str] = []
    wanted = os.environ.get("FAULTS", "")

    def add(name: str, strike: Callable[[int], Outcome], is_end: Callable[[Outcome], bool]) -> None:
        if not re.search(wanted, name):
            return
        outcomes = [strike(seed) for seed in track(range(1, moments + 1), description=name, transient=True)]
        bad_ends = [outcome for outcome in outcomes if not is_end(outcome)]
        wrong.extend(f"{name}: exit status {outcome.exit_status}, {outcome.ended}" for outcome in bad_ends)
        table.add_row(name, *_counts(outcomes), str(len(bad_ends)), str(min(outcome.rows for outcome in outcomes)))

    for fault in FAULTS:
        add(fault.name, lambda seed, fault=fault: run_fault(fault, seed), _ends_as(fault.ends))  # type: ignore[misc]
    for one in PLANT_CAMPAIGN:
        add(one.name, lambda seed, one=one: run_plant_fault(one, seed), _ends_as(one.ends))  # type: ignore[misc]
    for number, _, _ in SIGNALS:
        add(
            f"process: {number.name if number else 'disk full'}",
            lambda seed, number=number: strike_process(number, seed),  # type: ignore[misc]
            lambda outcome, number=number: is_right(number, outcome),  # type: ignore[misc]
        )
    for state in STATES:
        add(f"Ctrl-C: {state}", lambda seed, s=state: stop_in(s, seed), _is_stopped)  # type: ignore[misc]
    for kind, level, ends in PLANT_FAULTS:
        add(f"plant: {kind}", lambda seed, k=kind, v=level: plant_fault(k, v, seed), _ends_as(ends))  # type: ignore[misc]
    console = Console(highlight=False, width=110)
    console.print(table)
    for line in wrong:
        console.print(f"wrong end: {line}", markup=False)


def _is_stopped(outcome: Outcome) -> bool:
    return "stopped by Ctrl-C" in outcome.ended and outcome.exit_status == 130


def _ends_as(ends: Sequence[str]) -> Callable[[Outcome], bool]:
    def is_end(outcome: Outcome) -> bool:
        named = any(re.search(end, outcome.ended) for end in ends)
        return named and outcome.exit_status == (0 if outcome.ended == "completed" else 3)

    return is_end


def _counts(outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    return (
        str(len(outcomes)),
        str(sum(outcome.ended == "completed" for outcome in outcomes)),
        f"{max(outcome.safe_after_s for outcome in outcomes):.3f}",
        str(sum(outcome.beyond_limits for outcome in outcomes)),
        str(sum(outcome.bad_samples for outcome in outcomes)),
    )
