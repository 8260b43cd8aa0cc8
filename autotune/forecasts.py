"""Forecasts of a recording, window after window, whatever simulates: each from a state that the past before it tells.

Every window's state comes from a least-squares fit of a free run to the rows before it. How long that past is, and
whether an unknown constant part of the command is estimated with it, is chosen by which choice forecast the earlier
windows best, so nothing of a window is used before it is over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.errors import InputError
from autotune.recording import Recording

#: Past used for a state, in horizons.
PASTS = (0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
#: Past and whether a constant force is estimated too; what is taken where nothing is past yet.
CHOICES, FIRST_CHOICE = tuple((past, force) for past in PASTS for force in (False, True)), (0.5, False)
#: Rows that a state estimate needs at least, and of which it takes a third first, per state.
LEAST_PAST, ROWS_PER_STATE = 6, 6
#: Rows that a state is fitted to at least where a simulation runs away before more.
LEAST_FITTED = 4
#: Gauss-Newton steps of a state estimate, and the change of a state, in its size, that derivatives are taken over.
STEPS, CHANGE = 4, 1e-3
#: How fast old forecasts lose their say in which past is used, per window, and windows after which they have none.
MEMORY, REMEMBERED = 0.9, 60
#: Rows from which forecasts are tried, as shares of a window; more of them in the first.
ORIGINS, FIRST_ORIGINS = (0.0, 0.5), (0.2, 0.4, 0.6, 0.8)
#: Logarithm of the squared error by which a constant force must do better: it is one number more to be wrong.
LESS_SURE = 0.5
#: Distance from the readings that stands for a simulation that ran away, in their range.
FAR = 1e6


class Plant(Protocol):
    """What simulates a recording's rows from a state: a chain, equations."""

    @property
    def sizes(self) -> FloatArray:
        """How large each state typically is, (n,)."""

    @property
    def force_size(self) -> float:
        """How large a constant part of the command typically is [u unit]."""

    @property
    def is_linear(self) -> bool:
        """Whether readings are known to be linear in the state: one fit from anywhere finds it."""

    @property
    def linear(self) -> Plant | None:
        """The plant without what is not linear in it; None where nobody knows what that is."""

    def rest(self, row: int, reading: float) -> FloatArray:
        """Return the state nearest to rest before a row.

        Parameters
        ----------
        row : int
            The command of the row before it holds.
        reading : float
            What the state reads [y unit].

        Returns
        -------
        (n,) array
        """

    def run(self, first: int, last: int, state: FloatArray, force: float) -> tuple[FloatArray, FloatArray]:
        """Run free from a state.

        Parameters
        ----------
        first, last : int
            Rows, the last one left out.
        state : (n,) array
            At the first row.
        force : float
            What is added to the command [u unit].

        Returns
        -------
        readings : (last - first,) array
            Those after a simulation ended early are no numbers.
        end : (n,) array
            State at the last row.
        """


@dataclass(frozen=True, kw_only=True, eq=False)
class Forecaster:
    """Estimates states of a plant from a recording's readings, and forecasts from them.

    Attributes
    ----------
    plant : Plant
        n states.
    recording : Recording
        N rows; readings that are no number do not count.
    """

    plant: Plant
    recording: Recording

    def estimate(
        self, first: int, last: int, force: bool = False, known: Sequence[tuple[int, FloatArray]] = ()
    ) -> FloatArray:
        """Return the state at a row that fits rows from there on best.

        Rows are taken in growing numbers: what swings has one minimum near it for few rows, many for all.

        Parameters
        ----------
        first, last : int
            The rows, the last one left out.
        force : bool
            Whether a constant part of the command is estimated too.
        known : sequence of rows and estimates
            What was estimated before: begun from there too, where the first rows fit better than from rest.

        Returns
        -------
        (n,) or (n + 1,) array
            State, and force, each in units of its size.
        """
        counts = [last - first]
        while counts[-1] > ROWS_PER_STATE * (self.plant.sizes.size + force + 2):
            counts.append(counts[-1] // 3)
        starts = [self._at_rest(first, last), *self._reached(first, known)]
        z = min(starts, key=lambda x: self._error(first, first + counts[-1], x))
        z = np.append(z, [0.0] * force)
        while counts[-1] > LEAST_FITTED and not self._ends(first, first + counts[-1], z):
            counts.append(counts[-1] // 2)
        grown = self._settled(first, first + counts[-1], z, STEPS)
        for before, count in zip(counts[:0:-1], counts[-2::-1], strict=True):
            # where the state of fewer rows runs away before the next number of them, those up to there come first
            between = count
            while between - before > 1 and not self._ends(first, first + between, grown):
                between = (before + between) // 2
            for rows in sorted({between, count}):
                grown = self._settled(first, first + rows, grown, STEPS)
        if len(counts) == 1 or self.plant.is_linear:
            return grown
        direct = self._settled(first, last, z, STEPS + 2)
        return min(grown, direct, key=lambda s: self._error(first, last, s))

    def _at_rest(self, first: int, last: int) -> FloatArray:
        y = self.recording.y[first:last]
        read = y[np.isfinite(y)]
        return np.asarray(self.plant.rest(first, float(read[0]) if read.size else 0.0) / self.plant.sizes)

    def _reached(self, row: int, known: Sequence[tuple[int, FloatArray]]) -> list[FloatArray]:
        """Return the state that the last estimate before a row leads to there, where it does not run away."""
        before = [one for one in known if one[0] <= row]
        if self.plant.is_linear or not before:
            return []
        begin, z = before[-1]
        end = self._simulate(begin, row, z, self.plant)[1] if begin < row else z[: self.plant.sizes.size]
        return [end] if np.all(np.isfinite(end)) else []

    def run(self, first: int, last: int, z: FloatArray, plant: Plant | None = None) -> FloatArray:
        """Run free from an estimate.

        Parameters
        ----------
        first, last : int
            Rows, the last one left out.
        z : (n,) or (n + 1,) array
            State at the first row (and force), in sizes.
        plant : Plant, optional
            What runs instead of the plant.

        Returns
        -------
        (last - first,) array
            Readings.
        """
        return self._simulate(first, last, z, plant or self.plant)[0]

    def _simulate(self, first: int, last: int, z: FloatArray, plant: Plant) -> tuple[FloatArray, FloatArray]:
        """Return readings, and the last state in its size."""
        n, sizes = self.plant.sizes.size, self.plant.sizes
        force = float(z[n]) * self.plant.force_size if z.size > n else 0.0
        y, end = plant.run(first, last, z[:n] * sizes, force)
        return y, end / sizes

    def _ends(self, first: int, last: int, z: FloatArray) -> bool:
        """Whether a simulation from a state reaches the last row."""
        return bool(np.all(np.isfinite(self._left(first, last, z))))

    def _settled(self, first: int, last: int, z: FloatArray, iterations: int) -> FloatArray:
        if not np.isfinite(self.recording.y[first:last]).any():
            return z
        if not self.plant.is_linear and self.plant.linear is not None:
            # from rest no derivative leads out of dry friction: the linear plant tells how fast it was
            moving = self._fitted(first, last, z, 2, self.plant.linear)
            z = min(z, moving, key=lambda s: self._error(first, last, s))
        return self._fitted(first, last, z, iterations, self.plant)

    def _left(self, first: int, last: int, z: FloatArray, plant: Plant | None = None) -> FloatArray:
        """Return what a state leaves of the readings; nothing where one is missing."""
        y = self.recording.y[first:last]
        with np.errstate(over="ignore", invalid="ignore"):
            return np.where(np.isfinite(y), y - self.run(first, last, z, plant), 0.0)

    def _error(self, first: int, last: int, z: FloatArray) -> float:
        """Return the sum of squares that a state leaves; infinite where the simulation runs away."""
        with np.errstate(over="ignore", invalid="ignore"):
            return float(np.nan_to_num(np.sum(self._left(first, last, z) ** 2), nan=np.inf))

    def _fitted(self, first: int, last: int, z: FloatArray, iterations: int, plant: Plant) -> FloatArray:
        """Return the least-squares state near z; z itself where what runs away leaves no numbers to go by."""
        with np.errstate(over="ignore", invalid="ignore"):
            r, damping = self._left(first, last, z, plant), 1e-6
            for _ in range(iterations):
                J = np.empty((r.size, z.size))
                for i in range(z.size):
                    moved = z.copy()
                    moved[i] += CHANGE
                    J[:, i] = (self._left(first, last, moved, plant) - r) / CHANGE
                H = J.T @ J
                # what the rows do not tell (a lag of milliseconds, seconds ago) stays where rest put it
                H += np.diag(damping * np.diag(H) + 1e-9 * float(np.trace(H)) + 1e-300)
                step = -np.linalg.solve(H, J.T @ r)
                new = self._left(first, last, z + step, plant)
                if not np.all(np.isfinite(new)) or new @ new > r @ r:
                    damping = max(damping, 1e-6) * 100.0
                    continue
                small = r @ r - new @ new < 1e-6 * (r @ r)
                z, r = z + step, new
                if small:
                    break
        return z

    def windows(self, horizon_s: float) -> FloatArray:
        """Forecast window by window.

        Which past tells the state best is judged by forecasts of what was past already, begun at several rows of it:
        the mean logarithm of their errors, so that no single forecast decides.

        Parameters
        ----------
        horizon_s : float
            Length of a window [s].

        Returns
        -------
        (N,) array
            Simulated y. The first window has no past: its state is fitted to its own rows. A later one that
            runs away is ``FAR`` from the readings.

        Raises
        ------
        InputError
            A horizon shorter than two samples.
        """
        if not horizon_s >= 2.0 * self.recording.sample_time_s:
            raise InputError(f"horizon = {horizon_s:g} s", where="--horizon", remedy="give at least two sample times")
        t = self.recording.t
        count = int(np.floor((t[-1] - t[0]) / horizon_s + 1e-9)) + 1
        edges = np.searchsorted(t, t[0] + horizon_s * np.arange(count + 1) - 1e-9 * horizon_s)
        edges[-1] = t.size
        result = np.empty(t.size)
        begun = self.estimate(0, int(edges[1]))
        result[: edges[1]] = self.run(0, int(edges[1]), begun)
        known = [(0, begun)]
        tried: list[tuple[int, list[FloatArray]]] = []
        for k in range(1, count):
            a, b = int(edges[k]), int(edges[k + 1])
            begin = int(edges[k - 1])
            for share in FIRST_ORIGINS if k == 1 else ORIGINS:
                origin = begin + int(share * (a - begin))
                if origin > 2 * LEAST_PAST:
                    end = min(int(np.searchsorted(t, t[origin] + horizon_s)), t.size)
                    tried.append((origin, [one[0] for one in self._forecasts(origin, end, horizon_s, CHOICES, known)]))
            if a < b:
                choice = self._best_choice(tried, a, b, horizon_s)
                result[a:b], start, z = self._forecasts(a, b, horizon_s, [choice], known)[0]
                known = [*known, (start, z)][-REMEMBERED:]
            tried = tried[-REMEMBERED * len(ORIGINS) :]
        return result

    def _best_choice(
        self, tried: list[tuple[int, list[FloatArray]]], now: int, end: int, horizon_s: float
    ) -> tuple[float, bool]:
        """Return the past, and whether a force is estimated, that forecast the rows before now best.

        A past longer than any that there was before a forecast has not been tried: it was all rows, as shorter ones.
        """
        y, ok = self.recording.y, self._read
        errors, total = np.zeros(len(CHOICES)), 0.0
        for origin, paths in tried:
            stop = min(now, origin + paths[0].size)
            use = ok[origin:stop]
            if not use.any():
                continue
            squares = np.array([float(np.mean((y[origin:stop] - p[: stop - origin])[use] ** 2)) for p in paths])
            weight = MEMORY ** ((now - origin) / (end - now)) * (stop - origin) / (end - now)
            errors += weight * np.log(np.maximum(squares, 1e-3 * np.median(squares) + 1e-300))
            total += weight
        if total == 0.0:
            return FIRST_CHOICE
        errors += total * LESS_SURE * np.array([force for _, force in CHOICES])
        t = self.recording.t
        longest_s = (t[tried[-1][0]] - t[0]) * (1.0 + 1e-9)
        able = np.array([past * horizon_s <= longest_s for past, _ in CHOICES])
        return CHOICES[int(np.argmin(np.where(able, errors, np.inf) if able.any() else errors))]

    def _forecasts(
        self, origin: int, end: int, horizon_s: float, choices: Sequence[tuple[float, bool]],
        known: Sequence[tuple[int, FloatArray]],
    ) -> list[tuple[FloatArray, int, FloatArray]]:  # fmt: skip
        """Return forecasts from a row on, one for each choice of past and force, each with its row and estimate."""
        t = self.recording.t
        done: dict[tuple[int, bool], tuple[FloatArray, int, FloatArray]] = {}
        found = []
        for past, force in choices:
            start = max(min(int(np.searchsorted(t, t[origin] - past * horizon_s)), origin - LEAST_PAST), 0)
            if (start, force) not in done:
                z = self.estimate(start, origin, force, known)
                done[start, force] = self._bounded(self.run(start, end, z)[origin - start :]), start, z
            found.append(done[start, force])
        return found

    def _bounded(self, path: FloatArray) -> FloatArray:
        """Return a path no farther from the readings than what stands for running away."""
        low, high = self._bounds
        return np.clip(np.nan_to_num(path, nan=high), low, high)

    # of the whole recording, and asked for in every window
    @cached_property
    def _read(self) -> BoolArray:
        return np.isfinite(self.recording.y)

    @cached_property
    def _bounds(self) -> tuple[float, float]:
        low, high = float(np.nanmin(self.recording.y)), float(np.nanmax(self.recording.y))
        far = FAR * max(high - low, abs(low), abs(high))
        return low - far, high + far
