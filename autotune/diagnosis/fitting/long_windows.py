"""Windows of a rig: as long as the plant lets a simulation run free, and short ones to begin with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import BoolArray
from autotune.diagnosis.fitting.data import Data, as_white
from autotune.diagnosis.fitting.noise import Noise
from autotune.diagnosis.simulation.chain import build_chain
from autotune.diagnosis.thresholds import Thresholds
from autotune.models import Model
from autotune.poles import moving, slowest_mode_s
from autotune.recording import Recording


@dataclass(frozen=True, kw_only=True)
class Lengths:
    """How long windows are [s]."""

    short: float
    long: float
    swings: bool

    @property
    def between(self) -> tuple[float, ...]:
        """Lengths by which a fit goes from short windows to long ones."""
        if not self.swings or self.long < 1.5 * self.short:
            return (self.long,)
        if self.long < 6.0 * self.short:
            return (self.short, self.long)
        return (self.short, math.sqrt(self.short * self.long), self.long)


def lengths_of(model: Model, recordings: Sequence[Recording], limits: Thresholds) -> Lengths:
    """Return how long windows are: whole recordings, but for what integrates, rings for long, or has very many rows."""
    poles = np.linalg.eigvals(build_chain(model).A)
    settling = moving(poles)
    duration, dt = max(r.duration_s for r in recordings), recordings[0].sample_time_s
    slowest = slowest_mode_s(poles) or duration / 20.0
    damping = float(np.min(-settling.real / np.abs(settling))) if settling.size else 1.0
    long = duration
    if settling.size < poles.size:
        long = max(limits.long_window * slowest, limits.least_window_rows * dt)
    elif damping < limits.ringing:
        long = max(limits.long_window * 2.0 * math.pi * slowest, limits.least_window_rows * dt)
    elif sum(len(r) for r in recordings) > limits.searched_rows:
        # as many windows as are always kept, of all rows that are fitted
        long = max(limits.long_window * slowest, limits.rig_rows / limits.least_windows * dt)
    long = min(long, duration)
    short = min(max(0.5 * limits.long_window * slowest, limits.least_window_rows * dt), long)
    return Lengths(short=long if long < 1.5 * short else short, long=long, swings=damping < limits.swinging)


def spread_of(data: Data) -> float:
    """Return the standard deviation of the readings."""
    return float(np.std(np.concatenate([r.y[g] for r, g in zip(data.recordings, data.good, strict=True)]))) or 1.0


def cut(
    model: Model, recordings: Sequence[Recording], good: Sequence[BoolArray], length_s: float, limits: Thresholds
) -> Data:
    """Return recordings in windows of a length, thinned where they are long, their residuals taken for white.

    No window starts before the first command that is known has come through the dead time: a start state stands for all
    commands before it, but for those still on their way.
    """
    starts, stops = [], []
    for r in recordings:
        late_s = model.delay_s if np.ptp(r.u) > 0.0 else 0.0
        begins = max(r.t[r.first_reading], r.told_from_s(late_s))
        count = max(1, round((r.t[-1] - begins) / length_s))
        edges = begins + (r.t[-1] - begins) / count * np.arange(count)
        first = np.unique(np.searchsorted(r.t, edges - 1e-6 * r.sample_time_s)).astype(np.int64)
        starts.append(first)
        stops.append(np.append(first[1:], len(r)).astype(np.int64))
    data = Data(
        recordings=tuple(recordings),
        good=tuple(g & (np.arange(g.size) >= first[0]) for g, first in zip(good, starts, strict=True)),
        starts=tuple(starts), stops=tuple(stops), noise=Noise(sd=1.0), thresholds=limits,
    )  # fmt: skip
    data = data.thinned(limits.rig_rows)
    return as_white(data, spread_of(data))


def within(known: Data, recordings: Sequence[Recording], good: Sequence[BoolArray]) -> Data:
    """Return parts of recordings in the windows that all their rows were cut into, as far as these lie in them.

    A fit of all rows has a state in every row there, so that one of the part goes on where that simulation is.

    Parameters
    ----------
    known : Data
        All rows in windows, some of which may have been left out.
    recordings, good
        The parts, their rows numbered as there, and which of them count.
    """
    starts, stops = [], []
    for r, windows in zip(recordings, known.windows, strict=True):
        first, last = np.maximum(windows.starts, r.first_reading), np.minimum(windows.stops, len(r))
        most = 2 * (last - first) >= windows.stops - windows.starts
        able = most if most.any() else last > first
        starts.append(first[able])
        stops.append(last[able])
    data = Data(
        recordings=tuple(recordings), good=tuple(good), starts=tuple(starts), stops=tuple(stops), noise=Noise(sd=1.0),
        thresholds=known.thresholds,
    )  # fmt: skip
    data = data.only([np.ones(first.size, dtype=bool) for first in starts])
    return as_white(data, spread_of(data))
