"""The relay sweep: one limit cycle after the other, each left when its point is known well enough."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from autotune.config.procedure import ExperimentSettings, OperatingPointSettings
from autotune.errors import ExperimentStopped, IdentificationError
from autotune.experiment.approach import Known
from autotune.experiment.cycles import Earlier, measured
from autotune.experiment.limits import Envelope
from autotune.experiment.loop import ControlLoop
from autotune.experiment.oscillation import PATIENCE, Oscillation, mean_command
from autotune.experiment.plan import Choice, Goal, allot, choose, phase_targets, time_s, within_reach
from autotune.experiment.relay import RelaySettings
from autotune.experiment.result import Cycle, Segment, State
from autotune.identification.frequency.limit_cycle import WholePeriods

#: part of limits.swing that a limit cycle is planned for: the rest is for a mid-point that is not quite right
PEAK_SHARE = 0.87
#: the same for the first point, whose gain is foreseen from a short look at the plant
FIRST_PEAK_SHARE = 0.79
#: part of the amplitude so foreseen that it reaches for sure
FIRST_SURE = 0.9
LEAST_PERIODS = 2
#: residual of a limit cycle over that of the others (median) from which on it is said; under noise alone the largest of
#: 200 points was 1.05
UNEVEN = 1.1
#: asymmetry of the duty (part of the period, less one half) from which on the mid-point is corrected within a point
LARGEST_ASYMMETRY = 0.12

Show = Callable[[str, float, Known, RelaySettings], None]


def sweep(
    loop: ControlLoop,
    point: OperatingPointSettings,
    wanted: ExperimentSettings,
    known: Known,
    oscillation: Oscillation,
    show: Show,
    earlier: Earlier,
) -> tuple[tuple[Segment, ...], Known]:
    """Measure a point at every phase that is wanted and not yet measured, within the budget of rig time.

    Parameters
    ----------
    loop, point, wanted, known, oscillation
        The open loop, its operating point, the points that are wanted, what is known, and the relay that runs.
    show : callable
        Told what happens, the rig time that is expected to remain [s], what is known and which relay runs.
    earlier : Earlier
        Limit cycles that earlier sittings finished; their phases are passed over, their points and time count.

    Returns
    -------
    segments : tuple of Segment
        Earlier and new cycles, each with its point as the cycles before it knew the plant.
    known : Known
        What was learnt.

    Raises
    ------
    ExperimentStopped
        A limit, no oscillation, an asymmetry that does not go away, or an oscillation drowned in noise.
    """
    ends = _ends_deg(wanted, earlier)
    if not earlier.segments:
        ends = within_reach(ends, known.points[0], known.plant_sign)
    targets = _missing(ends, wanted, earlier)
    end_s = known.first_move_s + wanted.budget_s - earlier.swept_s
    part, count = len(earlier.recordings), len(earlier.segments)
    segments = list(earlier.segments)
    if segments:
        known = replace(
            known,
            points=tuple(one.point for one in segments),
            swept=True,
            warnings=sweep_warnings(segments, wanted, known.link_rad_s),
        )
    loop.note(first_move_s=known.first_move_s, phases_deg=list(ends))
    for i, target in enumerate(targets):
        goal = _goal(loop.envelope, wanted.relay_amplitude, known)
        choices = [_choice(goal, point.y, known, one) for one in targets[i:]]
        left_s = end_s - loop.tick.t_s
        sure = 1.0 if known.swept else FIRST_SURE
        periods = allot(choices, goal, wanted.gain_sd, LEAST_PERIODS, left_s, sure)
        expected_s = sum(time_s(choice, count) for choice, count in zip(choices, periods, strict=True))
        show(
            f"point {count + i + 1} of {count + len(targets)}: {math.degrees(target):.0f} deg",
            expected_s,
            known,
            choices[0].settings,
        )
        reserved_s = sum(time_s(choice, LEAST_PERIODS) for choice in choices[1:])
        foreseen = known.swept and wanted.relay_amplitude is None
        window = _measure(oscillation, choices[0], periods[0], end_s - reserved_s, settled=i > 0, foreseen=foreseen)
        cycle = Cycle(
            part=part,
            phase_rad=target,
            settings=oscillation.settings,
            start_s=window.start_s,
            end_s=window.end_s,
            periods=window.periods,
        )
        try:
            segment = measured(cycle, loop.history(), loop.sample_time_s, known.points if known.swept else ())
        except IdentificationError as error:
            raise ExperimentStopped(error.what, where=State.SWEEP.value, remedy=error.remedy) from error
        segments.append(segment)
        loop.note(relay=[one.to_table() for one in segments[count:]])
        known = replace(
            known,
            midpoint=segment.u_mean,
            noise_sd=segment.noise_sd,
            points=(*(known.points if known.swept else ()), segment.point),
            swept=True,
            warnings=sweep_warnings(segments, wanted, known.link_rad_s),
        )
    return tuple(segments), known


def missing_phases(wanted: ExperimentSettings, earlier: Earlier) -> tuple[float, ...]:
    """Return the phases of the positive-gain plant that no finished cycle has aimed at, in their order [rad]."""
    return _missing(_ends_deg(wanted, earlier), wanted, earlier)


def _ends_deg(wanted: ExperimentSettings, earlier: Earlier) -> tuple[float, float]:
    """Return the range of phases: that of an earlier sitting, else the wanted one [deg]."""
    noted = [one.metadata["phases_deg"] for one in earlier.recordings if "phases_deg" in one.metadata]
    first, last = noted[0] if noted and earlier.segments else wanted.phases_deg
    return float(first), float(last)


def _missing(ends_deg: tuple[float, float], wanted: ExperimentSettings, earlier: Earlier) -> tuple[float, ...]:
    done = [one.phase_rad for one in earlier.segments]
    targets = phase_targets(*ends_deg, wanted.points)
    return tuple(phase for phase in targets if not any(math.isclose(phase, other) for other in done))


def sweep_warnings(segments: Sequence[Segment], experiment: ExperimentSettings, link_rad_s: float) -> tuple[str, ...]:
    """Return what the reader should know of points not as good as was wanted, or beyond what the link supports."""
    wanted = experiment.gain_sd
    sds = [math.sqrt(float(np.trace(one.point.covariance)) / 2.0) / one.point.gain for one in segments]
    beyond = tuple(
        f"point at {omega:.3g} rad/s is beyond the {link_rad_s:.3g} rad/s that this link supports: its phase may be off"
        f" by {math.degrees(wanted * omega / link_rad_s):.2g} deg, use a link with less latency"
        for omega in (one.point.omega_rad_s for one in segments)
        if omega > link_rad_s
    )
    coarse = [sd > 1.1 * wanted for sd in sds]
    if not any(coarse):
        return beyond
    enough_s = experiment.budget_s * (max(sds) / wanted) ** 2  # a variance falls as the time grows
    residual = _over_others(segments)
    worst = max((i for i, one in enumerate(coarse) if one), key=lambda i: residual[i])
    at, first = segments[worst], ""
    if residual[worst] > UNEVEN:
        first = (
            f"look for an actuator at its limit, a load, or a start that had not settled at {at.start_s:.4g} to"
            f" {at.end_s:.4g} s, where y swings less evenly than elsewhere; else "
        )
    return (
        *beyond,
        f"{sum(coarse)} of {len(sds)} points are known to {100 * max(sds):.2g} % at worst, {100 * wanted:.2g} % was"
        f" wanted: {first}set experiment.budget_s = {float(f'{enough_s:.2g}'):g}",
    )


def _over_others(segments: Sequence[Segment]) -> list[float]:
    """Return every cycle's residual over the median of the others; 1 where there are too few to compare."""
    noise = np.array([one.noise_sd for one in segments])
    if noise.size < 3:
        return [1.0] * noise.size
    return [float(own / np.median(np.delete(noise, i))) for i, own in enumerate(noise)]


def _goal(envelope: Envelope, amplitude: float | None, known: Known) -> Goal:
    limits = envelope.settings
    return Goal(
        peak=(PEAK_SHARE if known.swept else FIRST_PEAK_SHARE) * limits.swing,
        noise_sd=known.noise_sd,
        sample_time_s=envelope.sample_time_s,
        u_step=envelope.u_step,
        u_room=0.95 * min(known.midpoint - limits.u_min, limits.u_max - known.midpoint),
        amplitude=amplitude,
    )


def _choice(goal: Goal, y_centre: float, known: Known, phase_rad: float) -> Choice:
    midpoint = known.midpoint
    if goal.u_step > 0.0:
        midpoint = goal.u_step * round(midpoint / goal.u_step)
    return choose(
        known.points,
        phase_rad,
        goal,
        midpoint=midpoint,
        y_centre=y_centre,
        plant_sign=known.plant_sign,
    )


def _measure(
    oscillation: Oscillation, choice: Choice, wanted: int, until_s: float, *, settled: bool, foreseen: bool
) -> WholePeriods:
    """Run one setting for whole periods, or until its time is over.

    Parameters
    ----------
    oscillation : Oscillation
        The relay, at the extremum of y.
    choice : Choice
        The setting.
    wanted : int
        Whole periods to measure.
    until_s : float
        When to end with fewer, but with no fewer than the least [s].
    settled : bool
        Whether the cycle before had the same peak: then this one is settled from its first row on.
    foreseen : bool
        Whether measured points say that the setting keeps within the swing.
    """
    loop = oscillation.loop
    step_s = loop.sample_time_s
    oscillation.change(
        choice.settings,
        patience_s=PATIENCE * math.pi / choice.omega_rad_s,
        turning_s=choice.turning_s,
        foreseen=foreseen,
    )
    # sample times count here and not rows: some may have been missed
    start, start_row, lead = loop.tick.slot if settled else -1, oscillation.start_row, 0
    turning = round(choice.turning_s / step_s)
    skip = 0  # edges before the cycle that is measured
    foreign = loop.monitor.commands.found
    disturbed = len(foreign)
    while True:
        tick, switched = oscillation.step()
        if len(foreign) > disturbed:  # its command was not this cycle's: anew, when it has died away for a period
            disturbed, skip, start = len(foreign), len(oscillation.edges) + 1, -1
        edges = oscillation.slots[skip:]
        if switched and len(edges) > 2 and _rebalanced(oscillation):
            skip, start = len(oscillation.edges) - 1, -1
            continue
        if start < 0 and edges:
            start, start_row, lead = edges[0] + turning, oscillation.edges[skip], turning
        if len(edges) < 2 * LEAST_PERIODS:
            continue
        period = (edges[-1] + edges[-2] - edges[1] - edges[0]) / (len(edges) - 2)
        periods = max(LEAST_PERIODS, min(wanted, int((until_s / step_s - start) / period)))
        # the next setting takes over at the extremum of y: not before it, and not when the next switch is near
        since_switch = tick.slot - edges[-1]
        at_extremum = turning <= since_switch <= turning + 0.15 * period
        if tick.slot < start + periods * period + 1 or not at_extremum:
            continue
        t = loop.history(start_row)[0]
        t = t[int(np.searchsorted(t, t[0] + (lead - 0.5) * step_s)) :]
        # a sample time on the clock of the stamps, which may be the device's
        slot_s = (t[-1] - t[0]) / round((t[-1] - t[0]) / step_s)
        return WholePeriods(start_s=float(t[0]), end_s=float(t[0] + periods * period * slot_s), periods=periods)


def _rebalanced(oscillation: Oscillation) -> bool:
    """Correct the mid-point where the last period was lopsided, and say whether it was."""
    settings = oscillation.settings
    mean = mean_command(oscillation.loop, oscillation.edges)
    if abs(mean - settings.midpoint) / settings.amplitude <= 2.0 * LARGEST_ASYMMETRY:
        return False
    step = oscillation.loop.envelope.u_step
    midpoint = step * round(mean / step) if step > 0.0 else mean
    if midpoint == settings.midpoint:
        return False
    oscillation.move_midpoint(midpoint)
    return True
