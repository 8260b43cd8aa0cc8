"""Recordings as a fit sees them: which rows count, where the state starts anew, what noise whitens the residuals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numba import njit

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis.fitting.noise import Noise
from autotune.diagnosis.simulation.assembly import spans_of
from autotune.diagnosis.simulation.simulator import Simulator, Windows
from autotune.diagnosis.thresholds import Thresholds
from autotune.recording import Recording

#: Rows that stay between windows that are apart, as many as a noise model looks back; the share of rows above which
#: data are left as they are.
BETWEEN, MOST_PACKED = 2, 0.8
_NOTHING = np.empty(0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Data:
    """Recordings with what a fit needs to know of them.

    Attributes
    ----------
    recordings : tuple of Recording
        What was measured.
    good : tuple of (N,) bool array
        Rows whose reading counts.
    starts : tuple of (W,) int array
        Rows where the state starts anew: the first row alone, or every window's.
    stops : tuple of (W,) int array
        Rows before which the windows end.
    noise : Noise
        Autoregressive noise model that whitens residuals.
    thresholds : Thresholds
        What decides between two findings.
    numbers : tuple of int
        The recordings' numbers in the order given by the user.
    whole : Data, optional
        What these are a part of; nothing where all rows are here. Its recordings drive simulations all the same: what
        a play or a dead time holds at a window's beginning was commanded before.
    kept : tuple of (N,) int array
        The rows' numbers there.
    weights : tuple of float, optional
        What each recording's whitened residuals are multiplied by; nothing where all count alike.
    """

    recordings: tuple[Recording, ...]
    good: tuple[BoolArray, ...]
    starts: tuple[IntArray, ...]
    stops: tuple[IntArray, ...]
    noise: Noise
    thresholds: Thresholds = field(default_factory=Thresholds)
    numbers: tuple[int, ...] = ()
    whole: Data | None = None
    kept: tuple[IntArray, ...] = ()
    weights: tuple[float, ...] = ()

    def thinned(self, rows: int) -> Data:
        """Return the data with windows left out evenly, until about as many rows count.

        Windows in which u or y is largest or smallest stay: a limit that is rarely reached acts only there.
        """
        share = max(1.0, self.rows / rows)
        least = self.thresholds.least_windows
        if share < 1.5 or all(len(a) <= least for a in self.starts):
            return self
        chosen = []
        for r, a, ok in zip(self.recordings, self.starts, self.good, strict=True):
            count = max(least, round(len(a) / share))
            far = [extreme(np.where(ok, x, np.median(x[ok]))) for x in (r.u, r.y) for extreme in (np.argmin, np.argmax)]
            extremes = np.clip(np.searchsorted(a, far, side="right") - 1, 0, len(a) - 1)
            evenly = np.linspace(0, len(a) - 1, min(len(a), count)).round().astype(np.int64)
            chosen.append(np.unique(np.concatenate([evenly, extremes])))
        return self.only(chosen)

    def only(self, chosen: Iterable[IntArray | BoolArray]) -> Data:
        """Return the data with the chosen windows of every recording, by number or by mask; no other row counts."""
        starts, stops, good = [], [], []
        for keep, a, b, ok in zip(chosen, self.starts, self.stops, self.good, strict=True):
            inside = np.zeros(ok.size, dtype=bool)
            for first, last in zip(a[keep], b[keep], strict=True):
                inside[first:last] = True
            starts.append(a[keep])
            stops.append(b[keep])
            good.append(ok & inside)
        some = replace(self, starts=tuple(starts), stops=tuple(stops), good=tuple(good))
        return some._packed(self if self.whole is None else self.whole)

    def _packed(self, whole: Data) -> Data:
        """Return the data with the rows of the windows alone, where these are not most of all rows.

        ``whole`` is what the windows were chosen from. Between windows that were apart two rows stay that do not count:
        no difference reaches across them.
        """
        inside = [np.zeros(len(r), dtype=bool) for r in self.recordings]
        for mask, starts, stops in zip(inside, self.starts, self.stops, strict=True):
            for a, b in zip(starts, stops, strict=True):
                mask[a : b + BETWEEN] = True
        if sum(int(mask.sum()) for mask in inside) > MOST_PACKED * sum(mask.size for mask in inside):
            return self
        rows = [np.flatnonzero(mask) for mask in inside]
        numbers = rows if self.whole is None else [known[k] for known, k in zip(self.kept, rows, strict=True)]
        return replace(
            self,
            recordings=tuple(r.only(k) for r, k in zip(self.recordings, rows, strict=True)),
            good=tuple(ok[k] for ok, k in zip(self.good, rows, strict=True)),
            starts=tuple(np.searchsorted(k, a) for k, a in zip(rows, self.starts, strict=True)),
            stops=tuple(np.searchsorted(k, b - 1) + 1 for k, b in zip(rows, self.stops, strict=True)),
            whole=whole,
            kept=tuple(numbers),
        )

    def spread_out(self) -> Data:
        """Return the data with all rows of the recordings, those outside the windows not counting."""
        if self.whole is None:
            return self
        good = [np.zeros(len(r), dtype=bool) for r in self.driving]
        for mask, ok, k in zip(good, self.good, self.kept, strict=True):
            mask[k] = ok
        stops = tuple(k[b - 1] + 1 for k, b in zip(self.kept, self.stops, strict=True))
        return replace(
            self, recordings=self.driving, good=tuple(good), starts=self.first_rows, stops=stops, whole=None, kept=()
        )

    @property
    def driving(self) -> tuple[Recording, ...]:
        """The recordings with all their rows, whose commands drive simulations."""
        return self.recordings if self.whole is None else self.whole.recordings

    def driven_by(self, driving: Sequence[Recording]) -> Data:
        """Return the data with other recordings that drive simulations, as long as those that do."""
        if self.whole is None:
            return replace(self, recordings=tuple(driving))
        return replace(self, whole=replace(self.whole, recordings=tuple(driving)))

    def in_driving(self, number: int, rows: BoolArray) -> BoolArray:
        """Return rows of a recording as rows of it with all of them.

        Parameters
        ----------
        number : int
            Position of the recording.
        rows : (N,) bool array
            A mask of the rows that are here.
        """
        if self.whole is None:
            return rows
        mask = np.zeros(len(self.driving[number]), dtype=bool)
        mask[self.kept[number]] = rows
        return mask

    @cached_property
    def first_rows(self) -> tuple[IntArray, ...]:
        """The windows' first rows in the recordings with all their rows."""
        if self.whole is None:
            return self.starts
        return tuple(k[a] for k, a in zip(self.kept, self.starts, strict=True))

    @cached_property
    def rows(self) -> int:
        """Rows that count."""
        return int(sum(g.sum() for g in self.good))

    @cached_property
    def windows(self) -> tuple[Windows, ...]:
        """Every recording's windows, as a simulation takes them that is driven by all its rows."""
        if self.whole is None:
            return self.windows_here
        return tuple(
            Windows(starts=k[a], stops=k[b - 1] + 1, places=a, rows=k.size)
            for k, a, b in zip(self.kept, self.starts, self.stops, strict=True)
        )

    @property
    def windows_here(self) -> tuple[Windows, ...]:
        """Every recording's windows, as a simulation takes them that is driven by signals of the rows that are here."""
        return tuple(Windows(starts=a, stops=b) for a, b in zip(self.starts, self.stops, strict=True))

    @cached_property
    def edges(self) -> tuple[IntArray, IntArray]:
        """First row of every window and the row after its last, all recordings one after the other."""
        before = np.cumsum([0, *(len(r) for r in self.recordings[:-1])])
        first = np.concatenate([n + a for n, a in zip(before, self.starts, strict=True)])
        return first, np.concatenate([n + b for n, b in zip(before, self.stops, strict=True)])

    @cached_property
    def command_spread(self) -> float:
        """Standard deviation of all commands, 1 where none moves."""
        return float(np.std(np.concatenate([r.u for r in self.driving]))) or 1.0

    @cached_property
    def spans(self) -> tuple[float, float]:
        """Largest standard deviation of a command and of a recording's readings."""
        readings = [r.y[g] for r, g in zip(self.recordings, self.good, strict=True)]
        return spans_of([r.u for r in self.driving], readings)

    @cached_property
    def sample_times(self) -> tuple[float, ...]:
        """Sample time of every recording [s]."""
        return tuple(r.sample_time_s for r in self.driving)

    def state_sizes(self, sim: Simulator) -> FloatArray:
        """Return a size for every state of a simulated chain, (n,), see there."""
        return sim.state_sizes(*self.spans, min(self.sample_times))

    def whitened(self, residuals: list[FloatArray]) -> list[FloatArray]:
        """Return the residuals whitened by the noise model, zero where a row or one that it needs does not count."""
        return np.split(self._innovations(residuals, None), np.cumsum([len(r) for r in residuals])[:-1])

    def whitened_runs(self, signals: list[FloatArray]) -> FloatArray:
        """Return the whitened residuals of simulated signals, (N, at least 1) each, one recording after the other."""
        return self._innovations([r.y for r in self.recordings], [out[:, 0] for out in signals])

    def _innovations(self, values: list[FloatArray], simulated: list[FloatArray] | None) -> FloatArray:
        """Return what the noise model leaves of values, less those simulated, one recording after the other."""
        ar, sd = np.array(self.noise.ar), self.noise.sd
        weights = self.weights or (1.0,) * len(self.recordings)
        e, at = np.zeros(sum(len(r) for r in values)), 0
        for k, (r, good, starts, weight) in enumerate(zip(values, self.good, self.starts, weights, strict=True)):
            run = _NOTHING if simulated is None else simulated[k]
            _innovations(r, run, good, starts, ar, sd / weight, e[at : at + len(r)])
            at += len(r)
        return e

    def beside(self, other: Data) -> Data:
        """Return the same rows in two divisions into windows as one, each by its own noise's standard deviation."""
        if self.whole is None or other.whole is None:
            mine, its = self.spread_out(), other.spread_out()
            whole: Data | None = None
            kept: tuple[IntArray, ...] = ()
        else:
            mine, its, kept = self, other, self.kept + other.kept
            whole = self.whole.beside(other.whole)
        return replace(
            mine,
            recordings=mine.recordings + its.recordings,
            good=mine.good + its.good,
            starts=mine.starts + its.starts,
            stops=mine.stops + its.stops,
            numbers=2 * (mine.numbers or tuple(range(len(mine.good)))),
            whole=whole,
            kept=kept,
            weights=(1.0,) * len(mine.good) + (mine.noise.sd / its.noise.sd,) * len(its.good),
        )


def as_white(data: Data, sd: float) -> Data:
    """Return data whose residuals are taken for white, of a standard deviation."""
    return replace(data, noise=replace(data.noise, sd=sd, ar=()))


@njit(cache=True, nogil=True)
def _innovations(
    y: FloatArray, run: FloatArray, good: BoolArray, starts: IntArray, ar: FloatArray, sd: float, e: FloatArray
) -> None:
    """Write e_k = (r_k - a1 r_{k-1} - ...) / sd of r = y - run, r before a start taken for zero, into zeros."""
    r = y - run if run.size else y
    for w in range(starts.size):
        for k in range(starts[w], starts[w + 1] if w + 1 < starts.size else r.size):
            counts, total = good[k], r[k]
            for lag in range(1, min(k - starts[w], ar.size) + 1):
                counts = counts and good[k - lag]
                total -= ar[lag - 1] * r[k - lag]
            if counts:
                e[k] = total / sd
