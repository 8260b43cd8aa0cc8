"""Forecasts without a name: nonlinear ARX, and a linear ARX with a Gaussian process of its residual.

Both run on rows so far apart that the plant's fastest time constant has twenty of them, the command as its mean in
between, and are interpolated to the rows that are judged. The past of a window is the measured one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from autotune.models import Model
from autotune.recording import Recording, read_recording
from tests.benchmarks._rival_cases import Case

#: Lags and degrees that are tried; weights of the ridge; points of the Gaussian process.
LAGS, DEGREES, RIDGES, POINTS = (1, 2, 3, 4), (1, 2, 3), (1e-8, 1e-5, 1e-2), 400
ROWS_PER_CONSTANT = 20
#: Rows that are left of a recording at the least.
LEAST_ROWS = 100
#: A run that leaves the recorded range by this many spans is held there.
FAR = 3.0

#: Next reading from regressors, shape (windows, 2 lags).
Step: TypeAlias = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Sparse:
    """A recording on rows further apart: readings, mean commands, every how many rows."""

    t: np.ndarray
    u: np.ndarray
    y: np.ndarray
    every: int


def windows(t: np.ndarray, horizon_s: float | None, score_from_s: float) -> list[tuple[int, int]]:
    """First and last row (excluded) of each forecast: one after the other from where the score begins."""
    first, dt = int(np.searchsorted(t, t[0] + score_from_s - 1e-9)), float(np.median(np.diff(t)))
    length = len(t) if horizon_s is None else max(1, round(horizon_s / dt))
    return [(k, min(k + length, len(t))) for k in range(first, len(t), length)]


def nrmse(t: np.ndarray, y: np.ndarray, forecast: np.ndarray, score_from_s: float) -> float:
    """Error over the spread of y, on the rows that are judged."""
    late = (t >= t[0] + score_from_s - 1e-9) & np.isfinite(y)
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean((y - forecast)[late] ** 2)) / np.std(y[late]))


def every(model: Model, dt: float, horizon_s: float | None, rows: int) -> int:
    """Every how many rows, from the plant's fastest time constant or period, the horizon, and the rows there are."""
    plant = [b for b in model.blocks if b.place == "plant"] or list(model.blocks)
    poles = np.concatenate([np.zeros(0), *(np.roots(b.dynamics.den) for b in plant)])
    poles = poles[np.abs(poles) > 1e-9]
    if not len(poles):
        return 1
    fastest = min(2.0 * np.pi / abs(p) if abs(p.imag) > 1e-9 else 3.0 / abs(p) for p in poles)
    most = rows / LEAST_ROWS if horizon_s is None else min(rows / LEAST_ROWS, horizon_s / (10.0 * dt))
    return max(1, int(min(fastest / (ROWS_PER_CONSTANT * dt), most)))


def sparse(r: Recording, q: int, delay_rows: int) -> Sparse:
    """Take every q-th reading and the mean of the commands that act until the next one."""
    u = np.concatenate([np.full(delay_rows, r.u[0]), r.u[: len(r) - delay_rows]])
    count = len(r) // q
    return Sparse(
        t=r.t[: count * q : q], u=u[: count * q].reshape(count, q).mean(axis=1), y=r.y[: count * q : q], every=q
    )


def regressors(s: Sparse, lags: int) -> tuple[np.ndarray, np.ndarray]:
    """Past readings and commands, newest first, shape (rows, 2 lags), and what came after them."""
    past = [s.y[lags - i - 1 : len(s.y) - i - 1] for i in range(lags)]
    past += [s.u[lags - i - 1 : len(s.u) - i - 1] for i in range(lags)]
    return np.column_stack(past), s.y[lags:]


def run(step: Step, s: Sparse, lags: int, first: np.ndarray, length: int, limits: tuple[float, float]) -> np.ndarray:
    """Free runs of ``length`` rows from the measured past of each first row, shape (windows, length)."""
    y = np.column_stack([s.y[first - i] for i in range(lags)])
    out = np.empty((len(first), length))
    for k in range(length):
        out[:, k] = y[:, 0]
        at = np.minimum(first + k, len(s.u) - 1)
        u = np.column_stack([s.u[at - i] for i in range(lags)])
        y = np.column_stack([np.clip(step(np.hstack([y, u])), *limits), y[:, :-1]])
    return out


def forecast(step: Step, s: Sparse, lags: int, r: Recording, case: Case, limits: tuple[float, float]) -> np.ndarray:
    """Forecast of a recording at its own rows, window after window."""
    out = np.full(len(r), np.nan)
    spans = [(max(a, lags * s.every), b) for a, b in windows(r.t, case.horizon_s, case.score_from_s)]
    begins = np.array([min(a // s.every, len(s.t) - 1) for a, _ in spans])  # the last rows may be no whole step
    length = max((b - 1) // s.every - a // s.every for a, b in spans) + 2
    runs = run(step, s, lags, begins, length, limits)
    for (a, b), begin, values in zip(spans, begins, runs, strict=True):
        stamps = s.t[begin] + np.arange(length) * (s.t[1] - s.t[0])
        out[a:b] = np.interp(r.t[a:b], stamps, values)
    return out


def _polynomial(lags: int, degree: int, weight: float, data: Sequence[Sparse]) -> Step:
    from sklearn.linear_model import Ridge
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    X, y = (np.concatenate(parts) for parts in zip(*(regressors(s, lags) for s in data), strict=True))
    features = PolynomialFeatures(degree, include_bias=False)
    fitted = make_pipeline(StandardScaler(), features, StandardScaler(), Ridge(weight * len(y)))
    change = y - X[:, 0]
    fitted.fit(X, change)
    return lambda x: x[:, 0] + fitted.predict(x)


def _chosen(
    train: Sequence[Sparse], degrees: Sequence[int], steps: int, limits: tuple[float, float]
) -> tuple[int, Step]:
    """Lags and the step whose free runs through the last third of each recording err least, fitted to all of it."""
    early = [
        Sparse(t=s.t[: 2 * len(s.t) // 3], u=s.u[: 2 * len(s.u) // 3], y=s.y[: 2 * len(s.y) // 3], every=s.every)
        for s in train
    ]
    best = (np.inf, LAGS[0], degrees[0], RIDGES[0])
    for lags in LAGS:
        for degree in degrees:
            for weight in RIDGES:
                step = _polynomial(lags, degree, weight, early)
                e = [_last_third(step, s, lags, steps, limits) for s in train]
                best = min(best, (float(np.mean(e)), lags, degree, weight))
    _, lags, degree, weight = best
    return lags, _polynomial(lags, degree, weight, train)


def _last_third(step: Step, s: Sparse, lags: int, steps: int, limits: tuple[float, float]) -> float:
    begin = max(2 * len(s.y) // 3, lags)
    length = max(2, min(steps, len(s.y) - begin))
    first = np.arange(begin, max(len(s.y) - length + 1, begin + 1), length)
    runs = run(step, s, lags, first, length, limits)
    seen = s.y[np.minimum(first[:, None] + np.arange(length), len(s.y) - 1)]
    return float(np.mean((runs - seen) ** 2))


def _prepared(case: Case, model: Model) -> tuple[list[Sparse], int, int, int, tuple[float, float]]:
    given = [read_recording(path) for path in case.given]
    dt = given[0].sample_time_s
    q = every(model, dt, case.horizon_s, min(len(r) for r in given))
    late = round(sum(b.dynamics.delay_s for b in model.blocks) / dt)
    train = [sparse(r, q, late) for r in given]
    low, high = (f(np.concatenate([s.y for s in train])) for f in (np.min, np.max))
    steps = 10**9 if case.horizon_s is None else max(2, round(case.horizon_s / (q * dt)))
    return train, q, late, steps, (low - FAR * (high - low), high + FAR * (high - low))


def _error(case: Case, step: Step, lags: int, q: int, late: int, limits: tuple[float, float]) -> float:
    errors = []
    for path in case.kept_back:
        r = read_recording(path)
        y = forecast(step, sparse(r, q, late), lags, r, case, limits)
        known = np.isfinite(y)
        errors.append(nrmse(r.t[known], r.y[known], y[known], max(case.score_from_s - (r.t[known][0] - r.t[0]), 0.0)))
    return float(np.mean(errors))


def narx(case: Case, model: Model) -> float:
    """Error of a polynomial ARX whose lags, degree and ridge are chosen by free runs on the last third."""
    train, q, late, steps, limits = _prepared(case, model)
    lags, step = _chosen(train, DEGREES, steps, limits)
    return _error(case, step, lags, q, late, limits)


def gaussian_process(case: Case, model: Model) -> float:
    """Error of a linear ARX with a Gaussian process of what its one-step forecasts leave."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    train, q, late, steps, limits = _prepared(case, model)
    lags, linear = _chosen(train, (1,), steps, limits)
    X, y = (np.concatenate(parts) for parts in zip(*(regressors(s, lags) for s in train), strict=True))
    residual, scale = y - linear(X), X.std(axis=0) + 1e-12
    size = float(np.std(residual)) or 1.0
    some = np.random.default_rng(0).permutation(len(y))[:POINTS]
    kernel = ConstantKernel(0.5, (1e-4, 1e2)) * RBF(np.full(X.shape[1], 3.0), (0.1, 1e3)) + WhiteKernel(
        0.5, (1e-6, 1e1)
    )
    process = GaussianProcessRegressor(kernel, n_restarts_optimizer=0, random_state=0)
    process.fit(X[some] / scale, residual[some] / size)
    return _error(case, lambda x: linear(x) + size * process.predict(x / scale), lags, q, late, limits)
