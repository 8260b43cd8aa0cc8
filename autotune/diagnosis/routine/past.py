"""Predictions of y from its own past, a sine of the dominant period, and the past of one signal more.

The best one-step prediction in a linear loop is a linear function of the past of y and of u, whatever the controller
and the load are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis.routine.operation import Operation
from autotune.diagnosis.routine.thresholds import RoutineThresholds
from autotune.errors import InputError

#: Directions of the past below this share of the largest are rounding: a controller without noise ties u to y.
_ROUNDING = 1e-7


@dataclass(frozen=True, kw_only=True, eq=False)
class Past:
    """Rows of y that are predicted, and what a level, a sine and y's own past say of them.

    Attributes
    ----------
    of : Operation
        The recordings.
    every : int
        Rows of the operation in each mean.
    order : int
        Means that a prediction sees.
    rows : (N,) array of int
        Means that are predicted.
    own : (N, K) array
        Orthonormal basis of the levels, a sine of the dominant period and y's own past.
    left : (N,) array
        What the basis leaves of y.
    """

    of: Operation
    every: int
    order: int
    rows: IntArray
    own: FloatArray
    left: FloatArray

    def beside(self, x: FloatArray) -> FloatArray:
        """Return an orthonormal basis of what the past of a signal adds, (N, order) array or less."""
        lags = lags_of(means_of(self.of, self.every, x), self.rows, self.order)
        return basis_of(lags, self.own)


def past_of(operation: Operation, limits: RoutineThresholds) -> Past:
    """Return the rows that can be predicted, with what y's own past says of them.

    Parameters
    ----------
    operation : Operation
        The recordings.
    limits : RoutineThresholds
        Order and rows of the predictions.

    Raises
    ------
    InputError
        Hardly a row of y has a past to predict it by.
    """
    period, order = operation.period_rows, limits.order
    every = max(1, int(period / limits.predicted_per_period)) if np.isfinite(period) else 1
    lengths = np.diff(np.append(operation.starts, operation.u.size)) // every
    recording = np.repeat(np.arange(lengths.size), lengths)
    y = means_of(operation, every, operation.y)
    rows = np.flatnonzero(np.arange(y.size) - (np.cumsum(lengths) - lengths)[recording] >= order)
    there = np.isfinite(y)
    rows = rows[there[rows] & (2 * lags_of(there, rows, order).sum(1) >= order)]
    if rows.size < 6 * order:
        raise InputError(
            f"y can be predicted in {rows.size} place(s) only", where=", ".join(operation.names),
            remedy="give a longer record, or one in which less of y is missing",
        )  # fmt: skip
    y = y[np.maximum.accumulate(np.where(there, np.arange(y.size), int(np.argmax(there))))]  # what is missing is held
    inside = (recording[rows, None] == np.arange(lengths.size)).astype(np.float64)
    levels = basis_of(inside, np.empty((rows.size, 0)))
    own = np.column_stack([levels, basis_of(_sines(rows * every, inside, period), levels)])
    own = np.column_stack([own, basis_of(lags_of(y, rows, order), own)])
    target = y[rows] - levels @ (levels.T @ y[rows])
    return Past(of=operation, every=every, order=order, rows=rows, own=own, left=target - own @ (own.T @ target))


def _sines(rows: IntArray, inside: FloatArray, period: float) -> FloatArray:
    """Return sine and cosine of the dominant period for every recording, whose phases differ, (N, 2 R) array."""
    if not np.isfinite(period):
        return np.empty((rows.size, 0))
    angle = 2.0 * np.pi * rows[:, None] / period
    return np.column_stack([np.cos(angle) * inside, np.sin(angle) * inside])


def means_of(operation: Operation, every: int, x: FloatArray) -> FloatArray:
    """Return means of so many rows, none across the end of a recording.

    Parameters
    ----------
    operation : Operation
        The recordings.
    every : int
        Rows in each mean.
    x : (R,) array
        The signal on the rows of the operation.
    """
    parts = [x[operation.rows_of(i)] for i in range(operation.starts.size)]
    return np.concatenate([part[: part.size // every * every].reshape(-1, every).mean(1) for part in parts])


def lags_of(x: FloatArray | BoolArray, rows: IntArray, order: int) -> FloatArray:
    """Return the past of a signal at some rows, (N, order) array.

    Parameters
    ----------
    x : (M,) array
        The signal.
    rows : (N,) array of int
        Where.
    order : int
        Rows before each.
    """
    return np.asarray(x[rows[:, None] - np.arange(1, order + 1)])


def basis_of(columns: FloatArray, beside: FloatArray) -> FloatArray:
    """Return an orthonormal basis of what columns add to a basis; directions of rounding are left out.

    Parameters
    ----------
    columns : (N, M) array
        What is added.
    beside : (N, K) array
        Orthonormal; may have no column.
    """
    size = np.linalg.norm(columns - columns.mean(0), axis=0) if beside.size else np.linalg.norm(columns, axis=0)
    scaled = columns / np.maximum(size, 1e-300)
    for _ in range(2):  # twice: a controller without noise ties u to y, and what is left is small
        scaled = scaled - beside @ (beside.T @ scaled)
    left, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(left[:, sizes > _ROUNDING])
