"""PySINDy on what a linear model of the plant's rate leaves: terms of the residual, named as the physics that they are.

States are the smoothed reading and its derivatives; the command reaches the plant through the blocks before it, which
are given (generous, as is the state at a window's start, smoothed over both sides). A plant without dynamics gets no
answer.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.signal import cont2discrete, lfilter, savgol_filter

from autotune.models import Model
from autotune.recording import Recording, read_recording
from tests.benchmarks._rival_cases import Case
from tests.benchmarks._rival_forecasts import nrmse, windows
from tests.benchmarks.prove import LEVEL, MECHANICAL, SMOOTHING, THRESHOLDS, Smoothed, sindy_runs, terms

#: The linear terms of each library; they are fitted first and stay.
LINEAR = ("1", "v", "w", "x", "y")
BODY = {**MECHANICAL, "sin x": ("plant.sine_torque", lambda x, v, w: np.sin(x))}
SPEED = {
    **LEVEL,
    "|y|y": ("plant.quadratic_drag", lambda y, w: np.abs(y) * y),
    "sign(y)": ("plant.coulomb_friction", lambda y, w: np.sign(y)),
}


def _body(model: Model) -> int:
    """Index of the first block of the plant: the last blocks that have dynamics."""
    dynamic = [i for i, b in enumerate(model.blocks) if len(b.dynamics.den) > 1]
    plant = [i for i in dynamic if model.blocks[i].place == "plant"]
    return (plant or dynamic[-1:] or [-1])[0]


def smoothed(r: Recording, model: Model) -> Smoothed | None:
    """Return a recording as the regression sees it; None for a plant without dynamics."""
    first, dt = _body(model), r.sample_time_s
    if first < 0:
        return None
    late = round(sum(b.dynamics.delay_s for b in model.blocks) / dt)
    u = np.concatenate([np.full(late, r.u[0]), r.u[: len(r) - late]]) - model.input.offset
    for block in model.blocks[:first]:
        u = _through(u, block.dynamics.num, block.dynamics.den, dt)
    plant = [b for b in model.blocks[first:] if b.place != "sensor"] or list(model.blocks[first:])
    poles = np.concatenate([np.roots(b.dynamics.den) for b in plant])
    moving = poles[np.abs(poles) > 1e-9]
    constant = min((1.0 / abs(p) for p in moving), default=r.duration_s / 50.0)
    half = min(max(3, round(SMOOTHING * constant / dt)), (len(r) - 1) // 4)
    x = [savgol_filter(r.y - model.output.offset, 2 * half + 1, 3, deriv=d, delta=dt) for d in (0, 1, 2)]
    order = min(len(poles), 2)
    return Smoothed(
        states=np.column_stack(x[:order]), rates=np.column_stack(x[1 : order + 1]), w=u,
        y=r.y - model.output.offset, Ts=dt,
    )  # fmt: skip


def _through(u: np.ndarray, num: Any, den: Any, dt: float) -> np.ndarray:
    """Return a held signal after a block, at rest at its first value."""
    if len(den) == 1:
        return np.asarray(u * num[-1] / den[-1])
    b, a, _ = cont2discrete((np.atleast_1d(num), np.atleast_1d(den)), dt)
    rest = u[0] * num[-1] / den[-1] if den[-1] else 0.0
    return np.asarray(lfilter(b.ravel(), a, u - u[0]) + rest)


def _regression(X: np.ndarray, y: np.ndarray, threshold: float) -> np.ndarray:
    import pysindy as ps

    optimizer = ps.STLSQ(threshold=threshold, alpha=1e-6, normalize_columns=True)
    optimizer.fit(X, y[:, None])
    return np.asarray(optimizer.coef_).ravel()


def fitted(train: list[Smoothed], library: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the linear terms, and of the residual's terms; the threshold is chosen on the last thirds."""
    X = [terms(s, library) for s in train]
    rates = [s.rates[:, -1] for s in train]
    keep = np.std(np.vstack(X), axis=0) > 0.0
    keep[list(library).index("1")] = True
    linear = keep & np.array([name in LINEAR for name in library])

    def both(parts: list[slice], share: float) -> tuple[np.ndarray, np.ndarray]:
        A, b = (np.concatenate([one[p] for one, p in zip(values, parts, strict=True)]) for values in (X, rates))
        first = np.zeros(X[0].shape[1])
        first[linear] = np.linalg.lstsq(A[:, linear], b, rcond=None)[0]
        left = b - A @ first
        rest = np.zeros_like(first)
        rest[keep] = _regression(A[:, keep], left, share * float(np.std(left)) * np.sqrt(len(b)))
        return first, rest

    early = [slice(0, 2 * len(b) // 3) for b in rates]
    errors = []
    for share in THRESHOLDS:
        c = sum(both(early, share))
        errors.append(
            np.mean([np.mean((b[p.stop :] - A[p.stop :] @ c) ** 2) for A, b, p in zip(X, rates, early, strict=True)])
        )
    choice = max(i for i, error in enumerate(errors) if error <= 1.01 * min(errors))
    return both([slice(None)] * len(X), THRESHOLDS[choice])


def sindy(case: Case, model: Model) -> tuple[tuple[str, ...], float]:
    """Name of the largest term of the residual that is physics, and the forecast's error; NaN without an answer."""
    train = [smoothed(read_recording(path), model) for path in case.given]
    if train[0] is None:
        return (), float("nan")
    library = BODY if train[0].states.shape[1] == 2 else SPEED
    first, rest = fitted(train, library)
    size = np.std(np.vstack([terms(s, library) for s in train]), axis=0) * np.abs(rest)
    ranked = sorted(zip(size, (name for name, _ in library.values()), strict=True), reverse=True)
    names = [name for amount, name in ranked if name and amount > 0.0]
    errors = []
    for path in case.kept_back:
        r = read_recording(path)
        s = smoothed(r, model)
        spans = windows(r.t, case.horizon_s, case.score_from_s)
        starts = np.array([a for a, _ in spans])
        with np.errstate(all="ignore"):
            runs = sindy_runs(s, library, first + rest, s.states[starts].T.copy(), starts, max(b - a for a, b in spans))
        y = np.full(len(r), np.nan)
        for (a, b), values in zip(spans, runs, strict=True):
            y[a:b] = values[: b - a]
        errors.append(nrmse(r.t, s.y, np.nan_to_num(y), case.score_from_s))
    return tuple(names[:1]), float(np.mean(errors))
