"""Ctrl-C in every state of a run: the ball in process, in virtual time, stopped after a drawn number of commands."""

from __future__ import annotations

import functools
import random
import signal
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from autotune.config import Config, load_config
from autotune.controller import PIDController
from autotune.errors import OperatorStop
from autotune.experiment.result import ExperimentResult, State, Status
from autotune.experiment.run import run_experiment
from autotune.experiment.verify import run_verification
from autotune.pipeline import Analysis, analyse, hand_over
from autotune.pipeline.journal import Journal
from autotune.recording import read_recording
from drivers.simulated import SimulatedRig
from sim.plant import make_plant
from tests.drivers.campaign import Outcome

CONFIG = Path(__file__).parents[2] / "configs" / "ball_sim.toml"
OLD = PIDController(K=-0.01, Ti_s=6.0)

#: state (and for the sweep the limit cycle), and up to how many commands into it the operator waits
STATES: dict[str, int] = {
    State.PREFLIGHT.value: 50,
    State.APPROACH.value: 400,
    State.MIDPOINT.value: 200,
    **{f"limit cycle {k}": 250 for k in range(1, 4)},
    State.VERIFY.value: 2000,
    "hand-over": 3,
}


@dataclass(kw_only=True)
class Operator:
    """Presses Ctrl-C once, so many commands after a state was entered."""

    state: str
    wait: int
    sees: str = ""
    waits: bool = False

    def watch(self, progress: Status) -> None:
        """Look at the progress bar."""
        swept = progress.state == State.SWEEP
        self.sees = progress.message.split(" of ")[0] if swept else progress.state.value

    def command(self) -> None:
        """Live through one command, or any other access of the rig."""
        self.waits |= self.sees == self.state
        if self.waits:  # also into the next state, where this one was short
            self.wait -= 1
            if self.wait == 0:
                signal.raise_signal(signal.SIGINT)


class AttendedRig(SimulatedRig):
    """The ball with an operator beside it; it keeps the commands that it got."""

    def __init__(self, seed: int, operator: Operator) -> None:
        super().__init__(make_plant("ball", seed=seed), u_safe=0.0, controller=OLD)
        self.seed = seed
        self.operator = operator
        self.commands: list[float] = []

    def write(self, u: float) -> None:
        """Hold ``u`` [u unit] from now on."""
        self.commands.append(u)
        super().write(u)
        self.operator.command()

    def write_gains(self, controller: PIDController) -> None:
        """Take gains; the operator may stop it before, half-way and after."""
        self.operator.command()
        self._controller = PIDController(K=controller.K, Ti_s=self._controller.Ti_s)
        self.operator.command()
        super().write_gains(controller)
        self.operator.command()


@functools.cache
def finished(seed: int) -> tuple[ExperimentResult, Analysis]:
    """Return an experiment that nobody stopped, and its analysis."""
    config = load_config(CONFIG)
    with tempfile.TemporaryDirectory() as folder:
        rig = AttendedRig(seed, Operator(state="", wait=0))
        experiment = run_experiment(rig, config, Path(folder) / "sweep.csv")
    return experiment, analyse(experiment.points, config.design)


def stop_in(state: str, seed: int) -> Outcome:
    """Run until the operator stops it in the state.

    ``safe_after_s`` is 0 where the rig was left with its safe output, and infinite also where a hand-over left other
    gains than the old ones and the journal does not ask for these.
    """
    config = load_config(CONFIG)
    operator = Operator(state=state, wait=random.Random(seed).randint(1, STATES[state]))
    # what nobody stopped is run for a few rigs only
    rig = AttendedRig(1 + seed % 3 if state == State.VERIFY.value else seed, operator)
    recoverable = True
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.csv"
        ended, status = "completed", 0
        # a process that was started in the background ignores Ctrl-C until told otherwise
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            _stage(state, rig, config, path)
        except OperatorStop as error:
            ended, status = str(error), error.exit_status
        except KeyboardInterrupt:  # outside the loop; the command line says the same of it
            ended, status = "stopped by Ctrl-C", OperatorStop.exit_status
        finally:
            signal.signal(signal.SIGINT, before)
        rows = len(read_recording(path)) if state != "hand-over" else 0
        if state == "hand-over":
            recoverable = OLD in (rig.read_gains(), Journal(path).unfinished())
    limits = config.limits
    return Outcome(
        ended=ended,
        exit_status=status,
        safe_after_s=0.0 if recoverable and rig.command == limits.u_safe else float("inf"),
        beyond_limits=sum(not limits.u_min <= u <= limits.u_max for u in rig.commands),
        bad_samples=0,
        rows=rows,
    )


def _stage(state: str, rig: AttendedRig, config: Config, path: Path) -> None:
    watch: Callable[[Status], None] = rig.operator.watch
    if state == State.VERIFY.value:
        experiment, analysis = finished(rig.seed)
        run_verification(
            rig, config, analysis.controller, analysis.fit, path,
            u_rest=experiment.u_rest, noise_sd=experiment.noise_sd, on_status=watch,
        )  # fmt: skip
    elif state == "hand-over":
        rig.operator.sees = state
        hand_over(rig, PIDController(K=-0.025, Ti_s=3.6), path)
    else:
        run_experiment(rig, config, path, on_status=watch)
