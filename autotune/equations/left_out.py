"""Errors on stretches that were left out: the numbers of a fit moved to what the other rows say."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from autotune.arrays import FloatArray, IntArray
from autotune.equations.descent import Descent
from autotune.equations.fit_data import Fitted, data_of
from autotune.equations.simulate import drive_of
from autotune.recording import Recording


def left_out_squares(
    fitted: Fitted, recordings: Sequence[Recording], labels: Sequence[IntArray], count: int
) -> FloatArray:
    """Return the sum of squared errors on every stretch, with numbers fitted to the others.

    Parameters
    ----------
    fitted : Fitted
        A fit to all rows.
    recordings : sequence of Recording
        What it was fitted to; rows whose y is no number do not count.
    labels : sequence of (N,) int arrays
        Which stretch each row belongs to, counted from 0; -1 for what is never left out.
    count : int
        Number K of stretches.

    Returns
    -------
    (K,) array
        In the reading's unit squared; infinite where a simulation runs away.

    Notes
    -----
    Numbers and start states move by one Gauss-Newton step with the derivatives of the fit to all rows: first order, so
    that a stretch on which alone a threshold was felt is judged a little too well.
    """
    squares = np.zeros(count)
    for k, there in _refit_without(fitted, recordings, labels, count):
        squares[k] = _squares(there.simulated(), recordings, labels, k)
    return squares


def error_beside_still(fitted: Fitted, recordings: Sequence[Recording], labels: Sequence[IntArray]) -> float | None:
    """Return the error on left-out stretches as a share of what it is with inputs that stand still there.

    Parameters
    ----------
    fitted, recordings, labels
        As in :func:`left_out_squares`.

    Returns
    -------
    float or None
        Of the stretches in which an input moves, from a state that the rows before them tell; None where none does.
    """
    own = still = 0.0
    model, count = fitted.compiled.model, 1 + max(int(label.max(initial=-1)) for label in labels)
    for k, there in _refit_without(fitted, recordings, labels, count):
        driving = [r.standing_still(label == k, model.columns) for r, label in zip(recordings, labels, strict=True)]
        if any(one is not r for one, r in zip(driving, recordings, strict=True)):
            own += _squares(there.simulated(), recordings, labels, k)
            still += _squares(there.simulated([drive_of(model, r) for r in driving]), recordings, labels, k)
    return math.sqrt(own / still) if still > 0.0 else None


def _squares(runs: Sequence[FloatArray], recordings: Sequence[Recording], labels: Sequence[IntArray], k: int) -> float:
    """Return a stretch's sum of squared errors; infinite where a simulation runs away."""
    outs = [np.isfinite(r.y) & (label == k) for r, label in zip(recordings, labels, strict=True)]
    e = np.concatenate([(r.y - y)[out] for r, y, out in zip(recordings, runs, outs, strict=True)])
    return float(e @ e) if np.all(np.isfinite(e)) else math.inf


def _refit_without(
    fitted: Fitted, recordings: Sequence[Recording], labels: Sequence[IntArray], count: int
) -> Iterator[tuple[int, Descent]]:
    """Yield each stretch's number and a fit that has moved to what the other rows say."""
    compiled = fitted.compiled
    whole = [data_of(compiled, r, fitted.parameters, None, w) for r, w in zip(recordings, fitted.windows, strict=True)]
    which = np.flatnonzero([p.spread > 0.0 for p in compiled.parameters])
    begun = Descent(compiled, whole, which, fitted.z)
    for k in range(count):
        there = begun.on_fewer_rows([one.good & (label != k) for one, label in zip(whole, labels, strict=True)])
        there.step(most=1)
        begun.begin_as(there)
        yield k, there
