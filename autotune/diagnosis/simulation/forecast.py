"""Simulation against a recording as a forecast: the state estimated from the past alone, then a free run.

Every window's state comes from a least-squares fit of a free run to the rows before it. How long that past is, and
whether an unknown constant force is estimated with it, is chosen by which choice forecast the earlier windows best,
so nothing of a window is used before it is over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.simulation.assembly import assemble, input_size, spans_of
from autotune.diagnosis.simulation.simulator import Simulator, Windows
from autotune.effects import kind_of
from autotune.errors import InputError
from autotune.models import Model
from autotune.recording import Recording

#: Past used for a state, in horizons.
PASTS = (0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
#: Past and whether a constant force is estimated too; what is taken where nothing is past yet.
CHOICES, FIRST_CHOICE = tuple((past, bias) for past in PASTS for bias in (False, True)), (0.5, False)
#: Rows that a state estimate needs at least, and of which it takes a third first, per state.
LEAST_PAST, ROWS_PER_STATE = 6, 6
#: Gauss-Newton steps of a state estimate.
STEPS = 4
#: How fast old forecasts lose their say in which past is used, per window.
MEMORY = 0.9
#: Rows from which forecasts are tried, as shares of a window; more of them in the first.
ORIGINS, FIRST_ORIGINS = (0.0, 0.5), (0.2, 0.4, 0.6, 0.8)
#: Logarithm of the squared error by which a constant force must do better: it is one number more to be wrong.
LESS_SURE = 0.5
#: Reading that stands for a simulation that ran away.
FAR = 1e6


@dataclass(frozen=True, kw_only=True, eq=False)
class _Estimator:
    """What a state estimate needs that stays the same from window to window."""

    sim: Simulator
    linear: Simulator
    recording: Recording
    good: FloatArray
    scales: FloatArray
    bias_size: float
    dt_s: float

    def run(self, first: int, last: int, z: FloatArray, linear: bool = False) -> FloatArray:
        """Return simulated readings of rows first to last from the state (and bias) z, in units of the scales."""
        n = self.scales.size
        sim = self.linear if linear else self.sim
        if z.size > n:
            sim = replace(sim, u_offset=sim.u_offset + z[n] * self.bias_size)
        window = Windows(starts=np.array([first], dtype=np.int64), stops=np.array([last], dtype=np.int64))
        out, _ = sim.run(self.recording, z[:n] * self.scales, window, sample_time_s=self.dt_s, signals=1)
        return np.asarray(out[first:last, 0])

    def estimate(self, first: int, last: int, bias: bool) -> FloatArray:
        """Return the state at row first that fits rows first to last best (and a constant force, if asked).

        Rows are taken in growing numbers: what swings has one minimum near it for few rows, many for all.
        """
        y, ok = self.recording.y[first:last], self.good[first:last].astype(bool)
        start = self.sim.rest_state(self.recording.u[max(first - 1, 0)], float(y[ok][0]) if ok.any() else 0.0)
        z = np.append(start / self.scales, [0.0] * bias)
        counts = [last - first]
        while counts[-1] > ROWS_PER_STATE * (z.size + 2):
            counts.append(counts[-1] // 3)
        grown = z
        for count in counts[::-1]:
            grown = self._settled(first, first + count, grown, STEPS)
        if len(counts) == 1 or self.sim.is_linear:
            return grown
        direct = self._settled(first, last, z, STEPS + 2)
        return min(grown, direct, key=lambda s: self._error(first, last, s))

    def _settled(self, first: int, last: int, z: FloatArray, iterations: int) -> FloatArray:
        y, ok = self.recording.y[first:last], self.good[first:last].astype(bool)
        if not ok.any():
            return z
        if not self.sim.is_linear:
            # from rest no derivative leads out of dry friction: the linear chain tells how fast the plant was
            moving = self._fitted(first, last, z, y, ok, 2, linear=True)
            z = min(z, moving, key=lambda s: self._error(first, last, s))
        return self._fitted(first, last, z, y, ok, iterations, linear=False)

    def _error(self, first: int, last: int, z: FloatArray) -> float:
        """Return the sum of squares that a state leaves; infinite where the simulation runs away."""
        y, ok = self.recording.y[first:last], self.good[first:last].astype(bool)
        with np.errstate(over="ignore", invalid="ignore"):
            return float(np.nan_to_num(np.sum((y - self.run(first, last, z))[ok] ** 2), nan=np.inf))

    def _fitted(
        self, first: int, last: int, z: FloatArray, y: FloatArray, ok: BoolArray, iterations: int, linear: bool
    ) -> FloatArray:
        """Return the least-squares state near z."""

        def left(state: FloatArray) -> FloatArray:
            return np.where(ok, y - self.run(first, last, state, linear), 0.0)

        r = left(z)
        damping = 1e-6
        for _ in range(iterations):
            J = np.empty((r.size, z.size))
            for i in range(z.size):
                moved = z.copy()
                moved[i] += 1e-3
                J[:, i] = (left(moved) - r) / 1e-3
            H = J.T @ J
            # what the rows do not tell (a lag of milliseconds, seconds ago) stays where rest put it
            H += np.diag(damping * np.diag(H) + 1e-9 * float(np.trace(H)) + 1e-300)
            step = -np.linalg.solve(H, J.T @ r)
            new = left(z + step)
            if not np.all(np.isfinite(new)) or new @ new > r @ r:
                damping = max(damping, 1e-6) * 100.0
                continue
            small = r @ r - new @ new < 1e-6 * (r @ r)
            z, r = z + step, new
            if small:
                break
        return z


def forecast(model: Model, recording: Recording, horizon_s: float | None = None) -> FloatArray:
    """Simulate a model with a recording's u, its state taken from the recording's past.

    Parameters
    ----------
    model : Model
        Chain and effects.
    recording : Recording
        t, u and y; rows whose y is not a number do not count.
    horizon_s : float, optional
        Length of the windows [s] at whose starts the state is estimated anew; without it the state is estimated from
        the first tenth of the rows and everything runs free from there.

    Returns
    -------
    (N,) array
        Simulated y. The first window has no past: its state is fitted to its own rows.

    Raises
    ------
    InputError
        A horizon shorter than two samples, u that is not finite, or no finite y.
    """
    recording.require_finite(("u",))
    if any(kind_of(effect.name).late_stamps for effect in model.effects):
        recording = recording.at_even_times()  # the model says that stamps are wrong and samples even
    good = np.isfinite(recording.y)
    if good.sum() < 8:
        raise InputError("fewer than 8 finite readings", where=recording.name, remedy="record longer")
    full = assemble(model)
    # no derivative leads through a converter's steps: states are estimated without them
    sim = full.without_steps()
    estimator = _Estimator(
        sim=sim,
        linear=sim.linear(),
        recording=recording,
        good=good.astype(np.float64),
        scales=sim.state_sizes(*spans_of([recording.u], [recording.y[good]])),
        bias_size=input_size(model, [recording]),
        dt_s=recording.sample_time_s,
    )
    if horizon_s is None:
        rows = max(len(recording) // 10, min(len(recording), 8))
        return full.stepped(estimator.run(0, len(recording), estimator.estimate(0, rows, bias=False)))
    if not horizon_s >= 2.0 * recording.sample_time_s:
        raise InputError(f"horizon = {horizon_s:g} s", where="--horizon", remedy="give at least two sample times")
    return full.stepped(_windowed(estimator, horizon_s))


def _windowed(estimator: _Estimator, horizon_s: float) -> FloatArray:
    """Forecast window by window.

    Which past tells the state best is judged by forecasts of what was past already, begun at several rows of it: the
    mean logarithm of their errors, so that no single forecast decides.
    """
    t = estimator.recording.t
    count = int(np.floor((t[-1] - t[0]) / horizon_s + 1e-9)) + 1
    edges = np.searchsorted(t, t[0] + horizon_s * np.arange(count + 1) - 1e-9 * horizon_s)
    edges[-1] = t.size
    result = np.empty(t.size)
    first = estimator.estimate(0, int(edges[1]), bias=False)
    result[: edges[1]] = estimator.run(0, int(edges[1]), first)
    tried: list[tuple[int, list[FloatArray]]] = []
    for k in range(1, count):
        a, b = int(edges[k]), int(edges[k + 1])
        begin = int(edges[k - 1])
        for share in FIRST_ORIGINS if k == 1 else ORIGINS:
            origin = begin + int(share * (a - begin))
            if origin > 2 * LEAST_PAST:
                end = min(int(np.searchsorted(t, t[origin] + horizon_s)), t.size)
                tried.append((origin, _forecasts(estimator, origin, end, horizon_s, CHOICES)))
        if a < b:
            choice = _best_choice(estimator, tried, a, b)
            result[a:b] = _forecasts(estimator, a, b, horizon_s, [choice])[0]
    return result


def _best_choice(
    estimator: _Estimator, tried: list[tuple[int, list[FloatArray]]], now: int, end: int
) -> tuple[float, bool]:
    """Return the past, and whether a force is estimated, that forecast the rows before now best."""
    y, ok = estimator.recording.y, estimator.good.astype(bool)
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
    errors += total * LESS_SURE * np.array([bias for _, bias in CHOICES])
    return CHOICES[int(np.argmin(errors))]


def _forecasts(
    estimator: _Estimator, origin: int, end: int, horizon_s: float, choices: Sequence[tuple[float, bool]]
) -> list[FloatArray]:
    """Return the forecasts from a row on, one for each choice of past and force."""
    t = estimator.recording.t
    done: dict[tuple[int, bool], FloatArray] = {}
    paths = []
    for past, bias in choices:
        start = max(min(int(np.searchsorted(t, t[origin] - past * horizon_s)), origin - LEAST_PAST), 0)
        if (start, bias) not in done:
            path = estimator.run(start, end, estimator.estimate(start, origin, bias))[origin - start :]
            done[start, bias] = np.clip(np.nan_to_num(path, nan=FAR), -FAR, FAR)
        paths.append(done[start, bias])
    return paths
