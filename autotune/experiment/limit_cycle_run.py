"""One limit cycle of a sweep: a relay setting run for whole periods, its mid-point corrected on the way."""

from __future__ import annotations

import math

import numpy as np

from autotune.experiment.oscillation import PATIENCE, Oscillation, mean_command
from autotune.experiment.plan import Choice
from autotune.identification.frequency.limit_cycle import WholePeriods

#: whole periods that an estimate needs
LEAST_PERIODS = 2
#: asymmetry of the duty (part of the period, less one half) from which on the mid-point is corrected within a point
LARGEST_ASYMMETRY = 0.12


def run_limit_cycle(
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
        since_switch = tick.slot - edges[-1]
        at_extremum = turning <= since_switch <= turning + 0.15 * period
        if tick.slot < start + periods * period + 1 or not at_extremum:
            continue
        t = loop.history(start_row)[0]
        t = t[int(np.searchsorted(t, t[0] + (lead - 0.5) * step_s)) :]
        # a sample time on the clock of the stamps, which may be the device's
        slot_s = (t[-1] - t[0]) / round((t[-1] - t[0]) / step_s)
        return WholePeriods(start_s=float(t[0]), end_s=float(t[0] + periods * period * slot_s), periods=periods)


def _rebalance(oscillation: Oscillation) -> bool:
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
