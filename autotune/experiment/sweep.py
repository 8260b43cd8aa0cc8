"""The relay sweep: one limit cycle after the other, each left when its point is known well enough."""

from __future__ import annotations

import math
from collections.abc import Sequence

from autotune.config.procedure import ExperimentSettings, OperatingPointSettings
from autotune.experiment.cycles import Earlier
from autotune.experiment.dwell import Dwell, further_periods
from autotune.experiment.limit_cycle_run import LEAST_PERIODS
from autotune.experiment.local_model import LocalModel, lag_beyond_integrator
from autotune.experiment.loop import ControlLoop
from autotune.experiment.oscillation import Oscillation
from autotune.experiment.plan import Choice, allot, phase_targets, time_s, within_reach
from autotune.experiment.preflight import Known
from autotune.experiment.result import Segment
from autotune.experiment.sweep_run import Show, SweepRun, is_aimed
from autotune.experiment.sweep_warnings import relative_sd
from autotune.experiment.together import Price, is_together, was_tried

#: part of the amplitude so foreseen that it reaches for sure
FIRST_SURE = 0.9
#: limit cycles whose rows are estimated together
FEW = 3


def sweep(
    loop: ControlLoop,
    point: OperatingPointSettings,
    wanted: ExperimentSettings,
    known: Known,
    oscillation: Oscillation,
    show: Show,
    earlier: Earlier,
    price: Price | None = None,
) -> tuple[tuple[Segment, ...], Known]:
    """Measure a point at every phase that is wanted and not yet measured, within the budget of rig time.

    Three limit cycles, at the ends and in the middle of the range, are run first, and their rows estimated together;
    where the rows say that they may be, and all points are known well enough then, the sweep ends. Else every phase
    gets a limit cycle of its own, and the rows of all are asked once more: what refused them by chance is gone then,
    what the equation lacks shows the more.

    Parameters
    ----------
    loop, point, wanted, known, oscillation
        The open loop, its operating point, the points that are wanted, what is known, and the relay that runs.
    show : callable
        Told what happens, the rig time that is expected to remain [s], what is known and which relay runs.
    earlier : Earlier
        Limit cycles that earlier sittings finished; their phases are passed over, their points and time count.
    price : callable, optional
        Says what is left unknown of points that are estimated together costs the controller: the sweep then ends where
        the rest of the budget would make it better by less than 1 %.

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
    run = SweepRun(loop=loop, y_centre=point.y, wanted=wanted, oscillation=oscillation, show=show, earlier=earlier)
    loop.note(first_move_s=known.first_move_s, phases_deg=list(ends))
    run.know(known)
    every = phase_targets(*ends, wanted.points)
    if wanted.together and targets and len(every) >= FEW and not was_tried(earlier):
        # few and short cycles that an earlier sitting left are quicker run again than gone on with
        run.segments = []
        left = _together(run, every, end_s, price)
        if left is None:
            return tuple(run.segments), run.known
        targets = left
        run.segments = [*earlier.segments, *run.segments]
    run.measure_each()
    _one_by_one(run, targets, end_s)
    if run.looks:
        _once_more(run, every)
    return tuple(run.segments), run.known


def _one_by_one(run: SweepRun, targets: Sequence[float], end_s: float) -> None:
    """Give every phase a limit cycle of its own, as long as its point needs or the budget allows."""
    count = len(run.segments)
    for i, target in enumerate(targets):
        choices = run.choices(targets[i:])
        sure = 1.0 if run.known.swept else FIRST_SURE
        periods = allot(choices, run.goal, run.wanted.gain_sd, LEAST_PERIODS, end_s - run.loop.tick.t_s, sure)
        expected_s = sum(time_s(choice, count) for choice, count in zip(choices, periods, strict=True))
        said = f"point {count + i + 1} of {count + len(targets)}: {math.degrees(target):.0f} deg"
        run.tell(said, expected_s, choices[0].settings)
        reserved_s = sum(time_s(choice, LEAST_PERIODS) for choice in choices[1:])
        run.cycle(choices[0], periods[0], end_s - reserved_s)


def _together(run: SweepRun, targets: Sequence[float], end_s: float, price: Price | None) -> list[float] | None:
    """Run few limit cycles and estimate their rows together; return which phases need a cycle of their own, if any."""
    loop, budget_s = run.loop, run.wanted.budget_s
    first = (targets[0], targets[len(targets) // 2], targets[-1])
    run.far = True
    for i, target in enumerate(first):
        choices = run.choices(first[i:])
        remaining_s = sum(time_s(choice, LEAST_PERIODS) for choice in choices)
        said = f"limit cycle {i + 1} of {FEW}: {math.degrees(target):.0f} deg, for all points together"
        run.tell(said, remaining_s, choices[0].settings)
        run.cycle(choices[0], LEAST_PERIODS, end_s)
    run.far = False
    while True:
        found = run.look(targets, price)
        if found.why or found.estimate is None:
            break
        left_s = end_s - loop.tick.t_s
        share = found.wanted_sd(run.wanted.gain_sd, budget_s - left_s, budget_s) / found.estimate.worst_sd
        if share >= 1.0:
            break
        choices = run.choices(first)
        periods = _further(run, choices, share, left_s)
        if not any(periods):
            break
        most = max(range(len(first)), key=lambda i: periods[i] * 2.0 * math.pi / choices[i].omega_rad_s)
        # to much slower ones by way of the one between: y, as fast as it is, would go far before the relay answers
        most = min(most, 1 + first.index(run.segments[-1].phase_rad))
        remaining_s = sum(time_s(choice, count) for choice, count in zip(choices, periods, strict=True) if count)
        said = f"{found.words}: {math.degrees(first[most]):.0f} deg again"
        run.tell(said, remaining_s, choices[most].settings)
        run.cycle(choices[most], max(periods[most], LEAST_PERIODS), end_s)
    run.note_look(found, targets)
    if not found.why:
        return None
    run.tell(f"each point by itself: {found.why}", math.nan)
    run.settled = False
    return _by_themselves(run, first, [phase for phase in targets if phase not in first], end_s)


def _once_more(run: SweepRun, targets: Sequence[float]) -> None:
    """Ask the rows of all limit cycles, after those of the first were refused."""
    found = run.look(targets)
    run.note_look(found, targets)
    if not found.why:
        run.take_together()
    else:
        run.tell(f"each point by itself: {found.why}", 0.0)


def _further(run: SweepRun, choices: Sequence[Choice], share: float, left_s: float) -> tuple[int, ...]:
    """Return the further periods that each limit cycle needs, for the worst point to be known so much better."""
    noise, middle = max(run.known.noise_sd, 1e-300), sorted(run.known.points, key=lambda point: point.omega_rad_s)[1]
    model = LocalModel.through(middle.omega_rad_s, middle.gain, lag_beyond_integrator(middle, run.known.plant_sign))
    done = [
        Dwell(
            omega_rad_s=one.point.omega_rad_s,
            signal=4.0 / math.pi * one.settings.amplitude * one.point.gain / noise,
            periods=one.periods,
        )
        for one in run.segments
    ]
    ahead = [
        Dwell(omega_rad_s=one.omega_rad_s, signal=one.y_amplitude / noise, periods=LEAST_PERIODS) for one in choices
    ]
    return further_periods(done, ahead, model, run.loop.sample_time_s, factor=share, left_s=left_s)


def _by_themselves(run: SweepRun, first: Sequence[float], others: Sequence[float], end_s: float) -> list[float]:
    """Return the phases to be measured by themselves: those without a cycle, and the others again as time allows.

    The first three cycles are short, and followed on each other over large changes, whose transients a point by itself
    takes for its own: the coarsest are run again first.
    """
    wanted = list(others)
    left_s = end_s - run.loop.tick.t_s - sum(time_s(one, LEAST_PERIODS) for one in run.choices(others))
    sds = {one.phase_rad: relative_sd(one) for one in run.segments}
    for phase in sorted(first, key=lambda phase: -sds[phase]):
        needed_s = time_s(run.choices([phase])[0], LEAST_PERIODS)
        if needed_s <= left_s:
            wanted.append(phase)
            left_s -= needed_s
    return sorted(wanted)


def missing_phases(wanted: ExperimentSettings, earlier: Earlier) -> tuple[float, ...]:
    """Return the phases of the positive-gain plant that are still to be measured, in their order [rad].

    Parameters
    ----------
    wanted : ExperimentSettings
        What is asked of the sweep.
    earlier : Earlier
        What was measured of it.
    """
    if is_together(earlier):
        return ()
    return tuple(_missing(_ends_deg(wanted, earlier), wanted, earlier))


def _ends_deg(wanted: ExperimentSettings, earlier: Earlier) -> tuple[float, float]:
    """Return the range of phases: that of an earlier sitting, else the wanted one [deg]."""
    noted = [one.metadata["phases_deg"] for one in earlier.recordings if "phases_deg" in one.metadata]
    first, last = noted[0] if noted and earlier.segments else wanted.phases_deg
    return float(first), float(last)


def _missing(ends_deg: tuple[float, float], wanted: ExperimentSettings, earlier: Earlier) -> list[float]:
    """Return the wanted phases of a range [deg] that no limit cycle aimed at [rad]."""
    return [phase for phase in phase_targets(*ends_deg, wanted.points) if not is_aimed(phase, earlier.segments)]
