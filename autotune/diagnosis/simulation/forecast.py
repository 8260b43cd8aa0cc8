"""Simulation against a recording as a forecast: the state estimated from the past alone, then a free run.

Every window's state comes from a least-squares fit of a free run to the rows before it. How long that past is, and
whether an unknown constant force is estimated with it, is chosen by which choice forecast the earlier windows best,
so nothing of a window is used before it is over.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.simulation.assembly import assemble
from autotune.diagnosis.simulation.simulator import Simulator, Windows
from autotune.errors import InputError
from autotune.models import Model
from autotune.recording import Recording

#: Past used for a state, in horizons.
PASTS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
#: Rows that a state estimate needs at least.
LEAST_PAST = 30
#: How fast old forecasts lose their say in which past is used, per window.
MEMORY = 0.9


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

    def estimate(self, first: int, last: int, bias: bool, iterations: int = 6) -> FloatArray:
        """Return the state at row first that fits rows first to last best (and a constant force, if asked)."""
        y, ok = self.recording.y[first:last], self.good[first:last].astype(bool)
        start = self.sim.rest_state(self.recording.u[max(first - 1, 0)], float(y[ok][0]) if ok.any() else 0.0)
        z = np.append(start / self.scales, [0.0] * bias)
        if not self.sim.is_linear:
            # from rest no derivative leads out of dry friction: the linear chain tells how fast the plant was
            moving = self._fitted(first, last, z, y, ok, 2, linear=True)
            z = min(z, moving, key=lambda s: float(np.sum((y - self.run(first, last, s))[ok] ** 2)))
        return self._fitted(first, last, z, y, ok, iterations, linear=False)

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
        scales=sim.state_sizes([recording.u], [recording.y[good]]),
        bias_size=max(float(np.std(recording.u)), 1e-9),
        dt_s=recording.sample_time_s,
    )
    if horizon_s is None:
        rows = max(len(recording) // 10, min(len(recording), 8))
        return full.stepped(estimator.run(0, len(recording), estimator.estimate(0, rows, bias=False)))
    if not horizon_s >= 2.0 * recording.sample_time_s:
        raise InputError(f"horizon = {horizon_s:g} s", where="--horizon", remedy="give at least two sample times")
    return full.stepped(_windowed(estimator, horizon_s))


def _windowed(estimator: _Estimator, horizon_s: float) -> FloatArray:
    """Forecast window by window."""
    t = estimator.recording.t
    count = int(np.floor((t[-1] - t[0]) / horizon_s + 1e-9)) + 1
    edges = np.searchsorted(t, t[0] + horizon_s * np.arange(count + 1) - 1e-9 * horizon_s)
    edges[-1] = t.size
    result = np.empty(t.size)
    first = estimator.estimate(0, int(edges[1]), bias=False)
    result[: edges[1]] = estimator.run(0, int(edges[1]), first)
    choices = [(past, bias) for past in PASTS for bias in (False, True)]
    errors = np.zeros(len(choices))
    for k in range(1, count):
        a, b = int(edges[k]), int(edges[k + 1])
        if a == b:
            continue
        forecasts: list[FloatArray] = []
        done: dict[tuple[int, bool], FloatArray] = {}
        for past, bias in choices:
            start = min(int(np.searchsorted(t, t[a] - past * horizon_s)), max(a - LEAST_PAST, 0))
            if (start, bias) not in done:
                z = estimator.estimate(start, a, bias)
                done[start, bias] = estimator.run(start, b, z)[a - start :]
            forecasts.append(done[start, bias])
        # no experience yet: a past of two horizons without bias
        best = int(np.argmin(errors)) if k > 2 else choices.index((2.0, False))
        result[a:b] = forecasts[best]
        ok = estimator.good[a:b].astype(bool)
        y = estimator.recording.y[a:b]
        errors = MEMORY * errors + [float(np.sum((y - f)[ok] ** 2)) for f in forecasts]
    return result
