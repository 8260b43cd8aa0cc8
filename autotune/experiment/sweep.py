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
from autotune.experiment.result import Segment
from autotune.identification.describing import describing_function
from autotune.identification.frequency import LimitCycle, limit_cycle_points

#: part of limits.swing that a limit cycle is planned for: the rest is for a mid-point that is not quite right
PEAK_SHARE = 0.91
#: the same for the first point, whose gain is foreseen from a short look at the plant
FIRST_PEAK_SHARE = 0.84
LEAST_PERIODS = 2
#: asymmetry of the duty (part of the period, less one half) from which on the mid-point is corrected within a point
LARGEST_ASYMMETRY = 0.12

Show = Callable[[str, float], None]


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
        Told what happens and the rig time that is expected to remain [s].

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
        show(f"point {i + 1} of {len(targets)}: {math.degrees(targets[i]):.0f} deg", expected_s)
        reserved_s = sum(time_s(choice, LEAST_PERIODS) for choice in choices[1:])
        cycle = _measure(oscillation, config, choices[0], periods[0], end_s - reserved_s)
        segment = _segment(cycle, oscillation, loop.sample_time_s)
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
    return Swept(segments=tuple(segments), known=known)


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


def _measure(
    oscillation: Oscillation, config: Config, choice: Choice, wanted_periods: int, until_s: float
) -> LimitCycle:
    """Run one setting until its point is known well enough or its time is over."""
    loop = oscillation.loop
    oscillation.change(choice.settings, patience_s=PATIENCE * math.pi / choice.omega_rad_s)
    first = 0
    while True:
        _, switched = oscillation.step()
        edges = oscillation.edges
        if not switched:
            continue
        if len(edges) >= first + 3:
            first = _rebalanced(oscillation, edges, first)
        periods = (len(edges) - 1 - first) // 2
        if periods < LEAST_PERIODS or (len(edges) - 1 - first) % 2:
            continue
        period_s = (edges[-1] - edges[first]) * loop.sample_time_s / periods
        over = periods >= wanted_periods or loop.tick.t_s + period_s > until_s
        if not over:
            continue
        oscillation.step()  # the row after the switch completes one that was made in two steps
        t, u, y = loop.history(edges[first] - 2)
        try:
            cycle = limit_cycle_points(t, u, y)
        except IdentificationError as error:
            raise ExperimentStopped(str(error), where="relay sweep", mend=error.mend) from error
        _turn(oscillation, choice.turning_s)
        return cycle


def _turn(oscillation: Oscillation, turning_s: float) -> None:
    """Go on to the extremum of y, where the next setting's limit cycle joins this one's without a transient."""
    last_row = oscillation.edges[-1]
    while (oscillation.loop.tick.k - last_row) * oscillation.loop.sample_time_s < turning_s:
        oscillation.step()


def _rebalanced(oscillation: Oscillation, edges: list[int], first: int) -> int:
    """Correct the mid-point where the last period was lopsided; return the edge that the point starts from."""
    if (len(edges) - 1 - first) % 2:
        return first
    _, u, _ = oscillation.loop.history(edges[-3])
    settings = oscillation.settings
    mean = float(np.mean(u[: edges[-1] - edges[-3]]))
    if abs(mean - settings.midpoint) / settings.amplitude <= 2.0 * LARGEST_ASYMMETRY:
        return first
    step = oscillation.loop.envelope.u_step
    midpoint = step * round(mean / step) if step > 0.0 else mean
    if midpoint == settings.midpoint:
        return first
    oscillation.move_midpoint(midpoint)
    return len(edges) - 1


def _segment(cycle: LimitCycle, oscillation: Oscillation, sample_time_s: float) -> Segment:
    settings = oscillation.settings
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
