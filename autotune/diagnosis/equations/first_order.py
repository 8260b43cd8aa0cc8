"""What other start states and numbers of a fit make of a change of the readings, to first order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.equations.fit_data import Fitted
from autotune.equations.rest import state_scales
from autotune.equations.sensitivity import STEP, sensitivities
from autotune.equations.simulate import Drive


def explained(fitted: Fitted) -> FloatArray:
    """Return an orthonormal basis of what the numbers of a fit can explain, start states projected out."""
    U, s, _ = np.linalg.svd(fitted.jacobian, full_matrices=False)
    return np.asarray(U[:, s > 1.0])


def start_bases(fitted: Fitted, drive: Drive, rows: BoolArray, number: int) -> list[FloatArray]:
    """Return for each window of a recording an orthonormal basis of what its start state explains, rows that count."""
    w = fitted.windows[number]
    scales = state_scales(fitted.compiled, fitted.parameters, drive, w.states[0])
    s = sensitivities(
        fitted.compiled, fitted.parameters, drive, w, parameter_steps=np.ones(fitted.parameters.size),
        state_steps=STEP * scales, which=(),
    )  # fmt: skip
    found = []
    for a, b in zip(w.starts, w.stops, strict=True):
        X = np.nan_to_num(s.to_states[a:b][rows[a:b]] * scales)
        U, v, _ = np.linalg.svd(X, full_matrices=False)
        found.append(U[:, v > 1e-6 * max(float(v.max(initial=0.0)), 1e-300)])
    return found


def without_starts(
    d: FloatArray, fitted: Fitted, rows: Sequence[BoolArray], bases: Sequence[Sequence[FloatArray]]
) -> FloatArray:
    """Return a change of the readings at the rows that count without what other start states make of it."""
    parts, at = [], 0
    for w, ok, X in zip(fitted.windows, rows, bases, strict=True):
        here = d[at : at + int(ok.sum())].copy()
        at += here.size
        index = np.cumsum(ok) - 1
        for a, b, Q in zip(w.starts, w.stops, X, strict=True):
            part = index[a:b][ok[a:b]]
            here[part] -= Q @ (Q.T @ here[part])
        parts.append(here)
    return np.concatenate(parts)
