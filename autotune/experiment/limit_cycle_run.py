"""One limit cycle of a sweep: a relay setting run for whole periods, its mid-point corrected on the way."""

from __future__ import annotations

import math

import numpy as np

from autotune.arrays import FloatArray
from autotune.experiment.oscillation import PATIENCE, Oscillation, mean_command, noise_half
from autotune.experiment.plan import Choice
from autotune.identification.frequency.limit_cycle import WholePeriods

#: whole periods that an estimate needs
LEAST_PERIODS = 2
#: asymmetry of the duty (part of the period, less one half) from which on the mid-point is corrected within a point
LARGEST_ASYMMETRY = 0.12
#: relative difference of first and last period from which on a cycle has not settled: half of the room that a planned
#: peak leaves below the swing, as the next settings are planned from its gain
UNSETTLED = 0.06
#: half periods that a cycle is given at most to settle, beyond its whole periods
SETTLING = 2 * LEAST_PERIODS


def run_limit_cycle(
    oscillation: Oscillation, choice: Choice, wanted: int, until_s: float, *, settled: bool, foreseen: bool
) -> WholePeriods:
    """Run one setting for whole periods that repeat themselves, or until its time is over.

    Parameters
    ----------
    oscillation : Oscillation
        The relay; the setting takes over at the next extremum of y.
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
    oscillation.go_to_extremum()
    oscillation.change(
        choice.settings,
        patience_s=PATIENCE * math.pi / choice.omega_rad_s,
        turning_s=choice.turning_s,
        foreseen=foreseen,
    )
    # sample times count here and not rows: some may have been missed
    start, start_row, lead = loop.tick.slot if settled else -1, oscillation.start_row, 0
    turning = round(choice.turning_s / step_s)
    skip = moved = 0  # edges before the cycle that is measured; half periods by which its window was put off
    foreign = loop.monitor.commands.found
    disturbed = len(foreign)
    while True:
        tick, switched = oscillation.step()
        if len(foreign) > disturbed:  # its command was not this cycle's: anew, when it has died away for a period
            disturbed, skip, start = len(foreign), len(oscillation.edges) + 1, -1
        edges = oscillation.slots[skip:]
        if switched and len(edges) > 2 and _rebalance(oscillation):
            skip, start = len(oscillation.edges) - 1, -1
            continue
        if start < 0 and edges:
            start, start_row, lead = edges[0] + turning, oscillation.edges[skip], turning
        if len(edges) < 2 * LEAST_PERIODS:
            continue
        period = (edges[-1] + edges[-2] - edges[1] - edges[0]) / (len(edges) - 2)
        periods = max(LEAST_PERIODS, min(wanted, int((until_s / step_s - start) / period)))
        # the next setting takes over at the extremum of y: not before it, and not when the next switch is near
        if tick.slot < start + periods * period + 1 or not oscillation.is_turning:
            continue
        t, _, y = loop.history(start_row)
        inside = int(np.searchsorted(t, t[0] + (lead - 0.5) * step_s))
        t, y = t[inside:], y[inside:]
        if moved < SETTLING and tick.t_s < until_s and not _repeats(t, y, period * step_s, 0.5 * noise_half(loop)):
            skip += next(i for i, edge in enumerate(edges) if edge + turning > start)
            start, moved = -1, moved + 1
            continue
        # a sample time on the clock of the stamps, which may be the device's
        slot_s = (t[-1] - t[0]) / round((t[-1] - t[0]) / step_s)
        return WholePeriods(start_s=float(t[0]), end_s=float(t[0] + periods * period * slot_s), periods=periods)


def _repeats(t: FloatArray, y: FloatArray, period_s: float, noise_sd: float) -> bool:
    """Return whether y goes through the last period as it went through the first, but for noise and switching instants.

    Noise is in both, and moves the switches between them by as much of y; so does the sample of each switch.
    """
    last = t > t[-1] - period_s
    earlier = np.interp(t[last] - period_s * round((t[-1] - t[0]) / period_s - 1.0), t, y)
    size, apart = float(np.nanstd(y[last])), float(np.sqrt(np.nanmean((y[last] - earlier) ** 2)))
    step = float(np.sqrt(np.nanmean(np.diff(y) ** 2)))
    return apart <= UNSETTLED * size + 2.0 * noise_sd + step


def _rebalance(oscillation: Oscillation) -> bool:
    """Correct the mid-point where the last period was lopsided, and say whether it was."""
    settings = oscillation.settings
    mean = mean_command(oscillation.loop, oscillation.edges)
    if abs(mean - settings.midpoint) / settings.amplitude <= 2.0 * LARGEST_ASYMMETRY:
        return False
    envelope = oscillation.loop.envelope
    step, limits = envelope.u_step, envelope.settings
    # both levels stay within the command's range
    mean = min(max(mean, limits.u_min + settings.amplitude), limits.u_max - settings.amplitude)
    midpoint = step * round(mean / step) if step > 0.0 else mean
    if midpoint == settings.midpoint:
        return False
    oscillation.move_midpoint(midpoint)
    return True
