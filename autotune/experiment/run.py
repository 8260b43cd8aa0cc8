"""The experiment from connect to safe: the table of states, and what is told and kept on the way."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from autotune.config import Config
from autotune.errors import AutotuneError
from autotune.experiment.approach import Known, approach, find_midpoint, preflight
from autotune.experiment.limits import Envelope, Watch
from autotune.experiment.loop import ControlLoop
from autotune.experiment.relay import RelaySettings
from autotune.experiment.result import ExperimentResult, Progress, State
from autotune.experiment.rig import Rig
from autotune.experiment.sweep import Swept, sweep
from autotune.experiment.warm import warm_up
from autotune.recording import RecordingWriter

OnProgress = Callable[[Progress], None]


def envelope_of(config: Config) -> Envelope:
    """Return the safety envelope that the configuration asks for."""
    return Envelope(settings=config.limits, sample_time_s=config.signals.sample_time_s, u_step=config.signals.u_step)


def recording_metadata(config: Config) -> dict[str, Any]:
    """Return the first content of a recording's sidecar; a killed run leaves it as it is."""
    return {
        "name": config.name,
        "rig": config.rig.kind,
        "units": {"t": "s", "u": config.signals.u_unit, "y": config.signals.y_unit},
        "sample_time_s": config.signals.sample_time_s,
        "ended": {"reason": "still running, or killed: nothing was written at the end"},
    }


def run_experiment(
    rig: Rig, config: Config, recording: str | Path, *, on_progress: OnProgress | None = None
) -> ExperimentResult:
    """Run the whole experiment on a rig and leave it safe.

    Parameters
    ----------
    rig : Rig
        Closed.
    config : Config
        Limits, operating point, sweep.
    recording : path
        CSV to write; its sidecar gets settings, times and the reason it ended.
    on_progress : callable, optional
        Called a few times per second of rig time at most.

    Raises
    ------
    ExperimentStopped, LinkError, OperatorStop
        What ended it; the rig is safe and the recording readable.
    """
    writer = RecordingWriter(recording, ("t", "u", "y"), recording_metadata(config))
    warm_up()
    with ControlLoop(rig=rig, envelope=envelope_of(config), writer=writer) as loop:
        return experiment_on(loop, config, on_progress=on_progress)


def experiment_on(loop: ControlLoop, config: Config, *, on_progress: OnProgress | None = None) -> ExperimentResult:
    """Go through the states on an open loop; the plant is left at rest, under the command that holds it.

    Raises
    ------
    ExperimentStopped, LinkError, OperatorStop
        As :func:`run_experiment`; the loop's exit makes the rig safe.
    """
    journal = _Journal(loop, on_progress)
    try:
        journal.enter(State.PREFLIGHT)
        known = preflight(loop, config, journal.tell)
        journal.enter(State.APPROACH)
        known = approach(loop, config, known, journal.tell)
        journal.enter(State.MIDPOINT)
        known, oscillation = find_midpoint(loop, config, known, journal.tell)
        journal.enter(State.SWEEP)
        swept = sweep(loop, config, known, oscillation, journal.show)
    except AutotuneError as error:
        error.where = error.where or journal.state.value
        raise
    sweep_end_s = loop.tick.t_s
    journal.enter(State.HAND_BACK)
    journal.show("all points measured", 0.0, swept.known)
    loop.watch = Watch(afloat=True)
    result = _result(loop, swept, sweep_end_s)
    loop.step(loop.nearest(result.u_rest))
    return result


def float_on(loop: ControlLoop, config: Config, *, u_rest: float | None = None) -> Known:
    """Bring the plant from rest to its operating point on an open loop: for a verification after an experiment.

    Parameters
    ----------
    loop : ControlLoop
        Open.
    config : Config
        The same configuration.
    u_rest : float, optional
        Command that holds the operating point, where it is known already [u unit].

    Returns
    -------
    Known
        What was learnt; the plant is near its operating point, and the caller's law takes it from the next sample.
    """

    def silent(_: str) -> None:
        return

    known = approach(loop, config, preflight(loop, config, silent), silent, u_rest=u_rest)
    known, _ = find_midpoint(loop, config, known, silent)
    return known


def _result(loop: ControlLoop, swept: Swept, sweep_end_s: float) -> ExperimentResult:
    u_means = np.array([_mean_command(loop, segment.start_s, segment.end_s) for segment in swept.segments])
    spread = float(np.std(u_means, ddof=1)) if u_means.size > 1 else math.nan
    points = tuple(sorted((segment.point for segment in swept.segments), key=lambda point: point.omega_rad_s))
    known = swept.known
    return ExperimentResult(
        segments=swept.segments,
        points=points,
        plant_sign=known.plant_sign,
        u_rest=float(np.mean(u_means)),
        u_rest_sd=spread / math.sqrt(u_means.size),
        noise_sd=known.noise_sd,
        timing=loop.timing,
        rig_time_s=loop.tick.t_s,
        first_move_s=known.first_move_s,
        sweep_time_s=sweep_end_s - known.first_move_s,
        reason="completed",
        warnings=known.warnings,
    )


def _mean_command(loop: ControlLoop, start_s: float, end_s: float) -> float:
    t, u, _ = loop.history()
    return float(np.mean(u[(t >= start_s) & (t < end_s)]))


class _Journal:
    """Keeps the states and their times in the sidecar and the recording, and tells whoever listens."""

    def __init__(self, loop: ControlLoop, on_progress: OnProgress | None) -> None:
        self.state = State.CONNECT
        self._loop = loop
        self._on_progress = on_progress
        self._states: list[dict[str, Any]] = []
        loop.metadata["states"] = self._states

    def enter(self, state: State) -> None:
        self.state = state
        self._states.append({"name": state.value, "start_s": self._loop.tick.t_s})
        self._loop.comment(f"state {state.value}")

    def tell(self, message: str) -> None:
        self.show(message, math.nan)

    def show(
        self, message: str, remaining_s: float, known: Known | None = None, relay: RelaySettings | None = None
    ) -> None:
        self._loop.comment(message)
        if self._on_progress is not None:
            self._on_progress(
                Progress(
                    state=self.state,
                    elapsed_s=self._loop.tick.t_s,
                    remaining_s=remaining_s,
                    message=message,
                    points=known.points if known is not None and known.swept else (),
                    relay=relay,
                    warnings=known.warnings if known is not None else (),
                )
            )
