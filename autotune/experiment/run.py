"""The experiment from connect to safe: the table of states, and what is told and kept on the way."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from autotune.config import Config
from autotune.errors import AutotuneError, ExperimentStopped
from autotune.experiment.approach import approach, find_midpoint
from autotune.experiment.cycles import Earlier, noise_of, refine_cycles
from autotune.experiment.device import DeviceOscillation
from autotune.experiment.limits import Envelope, Watch
from autotune.experiment.loop import ControlLoop, Timing
from autotune.experiment.preflight import Known, preflight, silent
from autotune.experiment.relay import RelaySettings
from autotune.experiment.result import ExperimentResult, Part, Segment, State, Status
from autotune.experiment.return_to_setpoint import return_by_relay, setpoint_before
from autotune.experiment.rig import Rig, RunsRelay, ShowsOutput
from autotune.experiment.sweep import missing_phases, sweep
from autotune.experiment.sweep_warnings import sweep_warnings
from autotune.experiment.together import Price, is_together
from autotune.identification.frequency.windows import Rows
from autotune.identification.sweep_noted import estimate_again, reason_noted
from autotune.recording import Recording, RecordingWriter

#: rows whose mean is compared with that of as many rows before, to see whether y stands still
REST_ROWS = 50
#: share of missed samples from which on the reader is told
NOTABLE_SHARE = 0.005
#: part of limits.time_s to wait for that
REST_SHARE = 0.3

OnStatus = Callable[[Status], None]


def envelope_of(config: Config) -> Envelope:
    """Return the safety envelope that the configuration asks for."""
    return Envelope(settings=config.limits, sample_time_s=config.signals.sample_time_s, u_step=config.signals.u_step)


def further_columns(rig: Rig) -> tuple[str, ...]:
    """Return the columns that the rig's own words fill: what it says it applies, where it says so."""
    return ("u_applied",) if isinstance(rig, ShowsOutput) and rig.shows_output else ()


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
    rig: Rig,
    config: Config,
    recording: str | Path,
    *,
    earlier: Earlier | None = None,
    on_status: OnStatus | None = None,
    price: Price | None = None,
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
    earlier : Earlier, optional
        What an interrupted run of the same configuration left: only the phases that are missing are measured, and the
        rig is not touched where none is.
    on_status : callable, optional
        Called a few times per second of rig time at most.
    price : callable, optional
        As :func:`autotune.experiment.sweep.sweep`.

    Raises
    ------
    ExperimentStopped, LinkError, OperatorStop
        What ended it; the rig is safe and the recording readable.
    """
    earlier = earlier or Earlier()
    if not missing_phases(config.experiment, earlier):
        last_part = len(earlier.recordings) - 1
        kept = [one for one in earlier.segments if one.part == last_part or not is_together(earlier)]
        final = refine_cycles(kept, earlier.rows, config.signals.sample_time_s)
        last = earlier.recordings[-1].metadata
        known = Known(first_move_s=last.get("first_move_s", math.nan), link_rad_s=last.get("link_rad_s", math.inf))
        timing = Timing.from_table(last.get("timing", {}))
        return _result(final, config, earlier.parts, timing, known, last, earlier.rows(last_part))
    extra = further_columns(rig)
    writer = RecordingWriter(recording, ("t", "u", "y", *extra), recording_metadata(config))
    with ControlLoop(rig=rig, envelope=envelope_of(config), writer=writer, extra=extra) as loop:
        swept = _experiment_on(loop, config, earlier=earlier, on_status=on_status, price=price)
    sitting = len(earlier.recordings)

    def rows(number: int) -> Rows:
        return loop.history() if number == sitting else earlier.rows(number)

    # all cycles together, which takes many samples' time: the rig has been handed back
    final = refine_cycles(swept.segments, rows, config.signals.sample_time_s)
    parts = (*earlier.parts, swept.part)
    result = _result(final, config, parts, loop.timing, swept.known, loop.metadata, loop.history())
    return replace(result, output=loop.metadata["ended"]["output"], warnings=(*result.warnings, *loop.foreign))


@dataclass(frozen=True, kw_only=True)
class Swept:
    """What the loop ends with.

    Attributes
    ----------
    segments : tuple of Segment
        Finished limit cycles, the earlier ones among them, each with its first estimate.
    known : Known
        What was learnt.
    part : Part
        This sitting.
    """

    segments: tuple[Segment, ...]
    known: Known
    part: Part


def _experiment_on(
    loop: ControlLoop,
    config: Config,
    *,
    earlier: Earlier | None = None,
    on_status: OnStatus | None = None,
    price: Price | None = None,
) -> Swept:
    """Go through the states on an open loop; the plant is left at rest, under the command that holds it.

    Raises
    ------
    ExperimentStopped, LinkError, OperatorStop
        As :func:`run_experiment`; the loop's exit makes the rig safe.
    """
    earlier = earlier or Earlier()
    journal = _Journal(loop, on_status)
    try:
        journal.enter(State.PREFLIGHT)
        if earlier.recordings and config.operating_point.approach == "ramp":
            wait_for_rest(loop)
        point, wanted = config.operating_point, config.experiment
        known = preflight(loop, point, wanted.gain_sd, journal.tell, u_rest=earlier.u_rest)
        journal.enter(State.APPROACH)
        known = approach(loop, point, known, journal.tell, u_rest=earlier.u_rest)
        journal.enter(State.MIDPOINT)
        known, oscillation = find_midpoint(loop, point, wanted.relay_amplitude, known, journal.tell)
        if isinstance(loop.rig, RunsRelay):
            oscillation = DeviceOscillation(loop.rig, oscillation)
        journal.enter(State.SWEEP)
        segments, known = sweep(loop, point, wanted, known, oscillation, journal.show, earlier, price)
    except AutotuneError as error:
        error.where = error.where or journal.state.value
        raise
    part = Part(
        recording=loop.recording.name,
        points=sum(one.part == len(earlier.recordings) for one in segments),
        rig_time_s=loop.tick.t_s,
        sweep_time_s=loop.tick.t_s - known.first_move_s,
        ended="completed",
    )
    journal.enter(State.HAND_BACK)
    journal.show("all points measured", 0.0, known)
    loop.watch = Watch(in_range=True)
    setpoint = setpoint_before(loop.rig, point.y, config.limits.swing)
    if math.isfinite(setpoint) and not return_by_relay(loop, oscillation, known, setpoint):
        journal.tell(
            f"y is at {loop.tick.y:.4g} and not at the set-point {setpoint:.4g} of the controller that takes over"
        )
    loop.step(loop.nearest(float(np.mean([segment.u_mean for segment in segments]))))
    return Swept(segments=segments, known=known, part=part)


def wait_for_rest(loop: ControlLoop) -> None:
    """Hold the safe command until y stands still: a plant may still be on its way back from what was done before.

    Parameters
    ----------
    loop : ControlLoop
        Open. Its ``limits.swing`` says what standing still is, ``limits.time_s`` how long to wait for it at most.

    Raises
    ------
    ExperimentStopped
        y still moves.
    """
    limits = loop.envelope.settings
    start_s, patience_s = loop.tick.t_s, REST_SHARE * limits.time_s
    while loop.tick.t_s - start_s <= patience_s:
        loop.step(loop.nearest(limits.u_safe))
        y = loop.history(max(0, loop.tick.k - 2 * REST_ROWS))[2]
        if y.size < 2 * REST_ROWS:
            continue
        change = abs(float(np.nanmean(y[REST_ROWS:]) - np.nanmean(y[:REST_ROWS])))
        noise_sd = float(np.nanstd(np.diff(y))) / math.sqrt(2.0)  # a slow movement is not in the differences
        if change < max(3.0 * noise_sd * math.sqrt(2.0 / REST_ROWS), 1e-3 * limits.swing):
            return
    raise ExperimentStopped(
        f"drifting: y still moves {patience_s:.3g} s after the safe command was set",
        remedy="wait until the plant is at rest and try again",
    )


def bring_to_operating_point(
    loop: ControlLoop, config: Config, *, u_rest: float | None = None, plant_sign: int = 0
) -> Known:
    """Bring the plant from rest to its operating point on an open loop: for a verification after an experiment.

    Parameters
    ----------
    loop : ControlLoop
        Open.
    config : Config
        The same configuration.
    u_rest : float, optional
        Command that holds the operating point, where it is known already [u unit].
    plant_sign : {-1, 0, 1}
        Sign of the plant's gain, where the experiment has seen it: a plant that still rings from before would have it
        measured wrongly.

    Returns
    -------
    Known
        What was learnt; the plant is near its operating point, and the caller's law takes it from the next sample.
    """
    point, wanted = config.operating_point, config.experiment
    known = preflight(loop, point, wanted.gain_sd, silent, u_rest=u_rest)
    if plant_sign and u_rest is not None:
        known = replace(known, plant_sign=plant_sign, sign_seen=True, midpoint_seen=True)
    known = approach(loop, point, known, silent, u_rest=u_rest)
    known, _ = find_midpoint(loop, point, wanted.relay_amplitude, known, silent)
    return known


def _result(
    segments: tuple[Segment, ...],
    config: Config,
    parts: tuple[Part, ...],
    timing: Timing,
    known: Known,
    noted: Mapping[str, Any],
    rows: Rows,
) -> ExperimentResult:
    u_means = np.array([segment.u_mean for segment in segments])
    spread = float(np.std(u_means, ddof=1)) if u_means.size > 1 else math.nan
    points = tuple(sorted((segment.point for segment in segments), key=lambda point: point.omega_rad_s))
    recording = Recording(t=rows[0], u=rows[1], y=rows[2], metadata=noted, name="sweep")
    together = estimate_again(recording, [segment.point for segment in segments])
    if together is not None:
        points = together.points
    return ExperimentResult(
        segments=segments,
        points=points,
        plant_sign=segments[-1].settings.plant_sign,
        u_rest=float(np.mean(u_means)),
        u_rest_sd=spread / math.sqrt(u_means.size),
        noise_sd=noise_of(segments),
        timing=timing,
        rig_time_s=sum(part.rig_time_s for part in parts),
        first_move_s=known.first_move_s,
        sweep_time_s=sum(part.sweep_time_s for part in parts),
        parts=parts,
        reason="completed",
        warnings=(
            *sweep_warnings(segments, config.experiment, known.link_rad_s, together),
            *_missed_text(timing),
        ),
        together=together,
        by_itself=reason_noted(noted),
    )


def _missed_text(timing: Timing) -> tuple[str, ...]:
    """Return what the reader should know of samples that were missed."""
    if timing.missed_share <= NOTABLE_SHARE:
        return ()
    return (
        f"{timing.missed} samples were missed, {100 * timing.missed_share:.2g} % of all: the loop was up to"
        f" {1e3 * timing.lateness_s[2]:.3g} ms late; autotune doctor CONFIG says what this computer does",
    )


class _Journal:
    """Keeps the states and their times in the sidecar and the recording, and tells whoever listens."""

    def __init__(self, loop: ControlLoop, on_status: OnStatus | None) -> None:
        self.state = State.CONNECT
        self._loop = loop
        self._on_status = on_status
        self._states: list[dict[str, Any]] = []

    def enter(self, state: State) -> None:
        self.state = state
        self._states.append({"name": state.value, "start_s": self._loop.tick.t_s})
        self._loop.note(states=self._states)
        self._loop.comment(f"state {state.value}")

    def tell(self, message: str) -> None:
        self.show(message, math.nan)

    def show(
        self, message: str, remaining_s: float, known: Known | None = None, relay: RelaySettings | None = None
    ) -> None:
        self._loop.comment(message)
        if self._on_status is not None:
            self._on_status(
                Status(
                    state=self.state,
                    elapsed_s=self._loop.tick.t_s,
                    remaining_s=remaining_s,
                    message=message,
                    points=known.points if known is not None and known.swept else (),
                    relay=relay,
                    warnings=known.warnings if known is not None else (),
                )
            )
