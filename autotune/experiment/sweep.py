"""The relay sweep: one limit cycle after the other, each left when its point is known well enough."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from autotune.config import Config
from autotune.errors import ExperimentStopped, IdentificationError
from autotune.experiment.approach import Known
from autotune.experiment.loop import ControlLoop
from autotune.experiment.oscillation import PATIENCE, Oscillation
from autotune.experiment.plan import Choice, Goal, allot, choose, phase_targets, time_s
from autotune.experiment.relay import RelaySettings
from autotune.experiment.result import Segment, State
from autotune.identification.frequency.describing import describing_function
from autotune.identification.frequency.limit_cycle import WholePeriods
from autotune.identification.frequency.limit_cycle_points import LimitCycle, limit_cycle_points

#: part of limits.swing that a limit cycle is planned for: the rest is for a mid-point that is not quite right
PEAK_SHARE = 0.87
#: the same for the first point, whose gain is foreseen from a short look at the plant
FIRST_PEAK_SHARE = 0.79
LEAST_PERIODS = 2
#: harmonics while the rig waits; the estimate that is kept is made with all of them at the end
FEW_HARMONICS = 7
#: asymmetry of the duty (part of the period, less one half) from which on the mid-point is corrected within a point
LARGEST_ASYMMETRY = 0.12

Show = Callable[[str, float, Known, RelaySettings], None]


@dataclass(frozen=True, kw_only=True)
class Swept:
    """What the sweep found: the segments, and what was learnt."""

    segments: tuple[Segment, ...]
    known: Known


def sweep(loop: ControlLoop, config: Config, known: Known, oscillation: Oscillation, show: Show) -> Swept:
    """Measure a point at every phase that is wanted, within the budget of rig time.

    Parameters
    ----------
    loop, config, known, oscillation
        The open loop, the settings, what is known, and the relay that runs.
    show : callable
        Told what happens, the rig time that is expected to remain [s], what is known and which relay runs.

    Raises
    ------
    ExperimentStopped
        A limit, no oscillation, an asymmetry that does not go away, or an oscillation drowned in noise.
    """
    wanted = config.experiment
    targets = phase_targets(*wanted.phases_deg, wanted.points)
    end_s = known.first_move_s + wanted.budget_s
    segments: list[Segment] = []
    for i, _ in enumerate(targets):
        choices = [_choice(config, known, target) for target in targets[i:]]
        goal = _goal(config, known)
        left_s = end_s - loop.tick.t_s
        periods = allot(choices, goal, wanted.gain_sd, LEAST_PERIODS, left_s)
        expected_s = sum(time_s(choice, count) for choice, count in zip(choices, periods, strict=True))
        show(
            f"point {i + 1} of {len(targets)}: {math.degrees(targets[i]):.0f} deg",
            expected_s,
            known,
            choices[0].settings,
        )
        reserved_s = sum(time_s(choice, LEAST_PERIODS) for choice in choices[1:])
        cycle = _measure(oscillation, choices[0], periods[0], end_s - reserved_s, known)
        segment = _segment(cycle, oscillation.settings, loop.sample_time_s)
        segments.append(segment)
        loop.metadata["relay"] = [one.metadata() for one in segments]
        sd = math.sqrt(float(np.trace(segment.point.covariance)) / 2.0) / segment.point.gain
        warnings = known.warnings
        if sd > 1.1 * wanted.gain_sd:
            warnings = (
                *warnings,
                f"point at {segment.point.omega_rad_s:.3g} rad/s is known to {100 * sd:.2g} % only,"
                f" {100 * wanted.gain_sd:.2g} % was wanted: raise experiment.budget_s",
            )
        known = replace(
            known,
            midpoint=cycle.u_mean,
            noise_sd=cycle.noise_sd,
            points=(*(known.points if known.swept else ()), segment.point),
            swept=True,
            warnings=warnings,
        )
    return _refined(loop, segments, known)


def _refined(loop: ControlLoop, segments: list[Segment], known: Known) -> Swept:
    """Estimate every cycle once more, now that the others make a better rough model of the plant."""
    refined = []
    for one in segments:
        t, u, y = loop.history()
        rows = (t >= one.start_s - 1e-9) & (t <= one.end_s + 2.0 * loop.sample_time_s)
        window = WholePeriods(start_s=one.start_s, end_s=one.end_s, periods=one.periods)
        others = [other.point for other in segments if other is not one]
        cycle = limit_cycle_points(t[rows], u[rows], y[rows], window=window, known=others)
        refined.append(_segment(cycle, one.settings, loop.sample_time_s))
    points = tuple(one.point for one in refined)
    return Swept(segments=tuple(refined), known=replace(known, points=points))


def _goal(config: Config, known: Known) -> Goal:
    limits = config.limits
    return Goal(
        peak=(PEAK_SHARE if known.swept else FIRST_PEAK_SHARE) * limits.swing,
        noise_sd=known.noise_sd,
        sample_time_s=config.signals.sample_time_s,
        u_step=config.signals.u_step,
        u_room=0.95 * min(known.midpoint - limits.u_min, limits.u_max - known.midpoint),
        amplitude=config.experiment.relay_amplitude,
    )


def _choice(config: Config, known: Known, phase_rad: float) -> Choice:
    midpoint = known.midpoint
    if config.signals.u_step > 0.0:
        midpoint = config.signals.u_step * round(midpoint / config.signals.u_step)
    return choose(
        known.points,
        phase_rad,
        _goal(config, known),
        midpoint=midpoint,
        y_centre=config.operating_point.y,
        plant_sign=known.plant_sign,
    )


def _measure(oscillation: Oscillation, choice: Choice, wanted: int, until_s: float, known: Known) -> LimitCycle:
    """Run one setting for whole periods, until its point is known well enough or its time is over.

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
    known : Known
        Points so far. Once the sweep has begun, the cycle before had the same peak: this one is settled from its first
        row on.
    """
    loop = oscillation.loop
    step_s = loop.sample_time_s
    oscillation.change(choice.settings, patience_s=PATIENCE * math.pi / choice.omega_rad_s)
    start = oscillation.start_row if known.swept else -1
    turning = round(choice.turning_s / step_s)
    skip = 0  # edges before the cycle that is measured
    while True:
        tick, switched = oscillation.step()
        edges = oscillation.edges[skip:]
        if switched and len(edges) > 2 and _rebalanced(oscillation, edges):
            skip, start = len(oscillation.edges) - 1, -1
            continue
        if start < 0 and edges:
            start = edges[0] + turning
        if len(edges) < 2 * LEAST_PERIODS:
            continue
        period = (edges[-1] + edges[-2] - edges[1] - edges[0]) / (len(edges) - 2)
        periods = max(LEAST_PERIODS, min(wanted, int((until_s / step_s - start) / period)))
        # the next setting takes over at the extremum of y: not before it, and not when the next switch is near
        since_switch = tick.k - edges[-1]
        at_extremum = turning <= since_switch <= turning + 0.15 * period
        if tick.k < start + periods * period + 1 or not at_extremum:
            continue
        t, u, y = loop.history(start)
        others = known.points if known.swept else ()
        window = WholePeriods(start_s=float(t[0]), end_s=float(t[0]) + periods * period * step_s, periods=periods)
        try:
            return limit_cycle_points(t, u, y, window=window, known=others, highest_harmonic=FEW_HARMONICS)
        except IdentificationError as error:
            raise ExperimentStopped(error.what, where=State.SWEEP.value, mend=error.mend) from error


def _rebalanced(oscillation: Oscillation, edges: list[int]) -> bool:
    """Correct the mid-point where the last period was lopsided, and say whether it was."""
    _, u, _ = oscillation.loop.history(edges[-3])
    settings = oscillation.settings
    mean = float(np.mean(u[: edges[-1] - edges[-3]]))
    if abs(mean - settings.midpoint) / settings.amplitude <= 2.0 * LARGEST_ASYMMETRY:
        return False
    step = oscillation.loop.envelope.u_step
    midpoint = step * round(mean / step) if step > 0.0 else mean
    if midpoint == settings.midpoint:
        return False
    oscillation.move_midpoint(midpoint)
    return True


def _segment(cycle: LimitCycle, settings: RelaySettings, sample_time_s: float) -> Segment:
    delay_s = (settings.delay_samples + 0.5 * (settings.smoothing - 1)) * sample_time_s
    return Segment(
        start_s=cycle.start_s,
        end_s=cycle.end_s,
        settings=settings,
        delay_s=delay_s,
        point=cycle.points[0],
        harmonics=cycle.points[1:],
        describing=describing_function(cycle, delay_s, plant_sign=settings.plant_sign),
        periods=cycle.periods,
        asymmetry=cycle.asymmetry,
    )
