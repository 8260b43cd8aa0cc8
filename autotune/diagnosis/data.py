"""Recordings as a fit sees them: which rows count, where the state starts anew, what noise whitens the residuals."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis.noise import Noise
from autotune.recording import Recording

#: Windows of a recording that thinning leaves: fewer would miss a direction or a level of the motion.
LEAST_WINDOWS_KEPT = 6


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
    numbers : tuple of int
        The recordings' numbers in the order given by the user.
    """

    recordings: tuple[Recording, ...]
    good: tuple[BoolArray, ...]
    starts: tuple[IntArray, ...]
    stops: tuple[IntArray, ...]
    noise: Noise
    numbers: tuple[int, ...] = ()

    def thinned(self, rows: int) -> Data:
        """Return the data with windows left out evenly, until about as many rows count.

        Windows in which u or y is largest or smallest stay: a limit that is rarely reached acts only there.
        """
        share = max(1.0, self.rows / rows)
        if share < 1.5:
            return self
        if all(len(a) <= LEAST_WINDOWS_KEPT for a in self.starts):
            return self
        chosen = []
        for r, a, ok in zip(self.recordings, self.starts, self.good, strict=True):
            count = min(len(a), max(LEAST_WINDOWS_KEPT, round(len(a) / share)))
            far = [extreme(np.where(ok, x, np.median(x[ok]))) for x in (r.u, r.y) for extreme in (np.argmin, np.argmax)]
            extremes = np.clip(np.searchsorted(a, far, side="right") - 1, 0, len(a) - 1)
            evenly = np.linspace(0, len(a) - 1, count).round().astype(np.int64)
            chosen.append(np.union1d(evenly, extremes))
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
        return replace(self, starts=tuple(starts), stops=tuple(stops), good=tuple(good))

    @property
    def rows(self) -> int:
        """Rows that count."""
        return int(sum(g.sum() for g in self.good))

    @cached_property
    def sample_times(self) -> tuple[float, ...]:
        """Sample time of every recording [s]."""
        return tuple(r.sample_time_s for r in self.recordings)

    @cached_property
    def _filtered_rows(self) -> tuple[tuple[tuple[IntArray, ...], BoolArray], ...]:
        """Per recording the rows that have a row before them at each lag, and those whose innovation counts."""
        result = []
        for good, starts in zip(self.good, self.starts, strict=True):
            use, fresh = good.copy(), np.zeros(good.size, dtype=bool)
            fresh[starts] = True
            rows = []
            for lag in range(1, len(self.noise.ar) + 1):
                back = np.flatnonzero(~fresh[lag:]) + lag
                use[back] &= good[back - lag]
                fresh[1:] |= fresh[:-1]  # a row that near to a start has no older one
                rows.append(back)
            result.append((tuple(rows), use))
        return tuple(result)

    def whitened(self, residuals: list[FloatArray]) -> list[FloatArray]:
        """Return the residuals whitened by the noise model, zero where a row or one that it needs does not count."""
        result = []
        for r, (rows, use) in zip(residuals, self._filtered_rows, strict=True):
            e = r.copy()
            for lag, (a, back) in enumerate(zip(self.noise.ar, rows, strict=True), start=1):
                e[back] -= a * r[back - lag]
            result.append(np.where(use, e / self.noise.sd, 0.0))
        return result
