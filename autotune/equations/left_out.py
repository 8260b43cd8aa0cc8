"""Errors on stretches that were left out: the numbers of a fit moved to what the other rows say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray, IntArray
from autotune.equations.descent import Descent
from autotune.equations.fit_data import Fitted, data_of
from autotune.recording import Recording


def left_out_squares(fitted: Fitted, recordings: Sequence[Recording], labels: Sequence[IntArray]) -> FloatArray:
    """Return the sum of squared errors on every stretch, with numbers fitted to the others.

    Parameters
    ----------
    fitted : Fitted
        A fit to all rows.
    recordings : sequence of Recording
        What it was fitted to; rows whose y is no number do not count.
    labels : sequence of (N,) int arrays
        Which stretch each row belongs to, counted from 0; -1 for what is never left out.

    Returns
    -------
    (K,) array
        In the reading's unit squared; infinite where a simulation runs away.

    Notes
    -----
    Numbers and start states move by one Gauss-Newton step with the derivatives of the fit to all rows: first order, so
    that a stretch on which alone a threshold was felt is judged a little too well.
    """
    compiled = fitted.compiled
    whole = [data_of(compiled, r, fitted.parameters, None, w) for r, w in zip(recordings, fitted.windows, strict=True)]
    which = np.flatnonzero([p.spread > 0.0 for p in compiled.parameters])
    known = Descent(compiled, whole, which, fitted.z).sensitivities()
    squares = np.zeros(1 + max(int(label.max(initial=-1)) for label in labels))
    for k in range(squares.size):
        kept = [replace(one, good=one.good & (label != k)) for one, label in zip(whole, labels, strict=True)]
        there = Descent(compiled, kept, which, fitted.z, known)
        there.step(most=1)
        for one, label, y in zip(whole, labels, there.simulated(), strict=True):
            out = one.good & (label == k)
            squares[k] += float(np.sum((one.y - y)[out] ** 2)) if np.all(np.isfinite(y[out])) else np.inf
    return squares
