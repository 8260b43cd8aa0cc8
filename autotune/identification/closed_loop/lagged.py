"""Triangular factors of lagged data, accumulated block by block: no block-Hankel matrix is ever in memory.

Subspace methods need the data only through the R factor of the matrix whose rows are lagged samples. Orthogonal
updating keeps the accuracy of a QR decomposition of the data themselves (a sum of lagged products would square the
condition number) in time linear in the samples and memory that does not depend on them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import qr

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError

#: Rows that are orthogonalised at once; a few thousand keep the block in cache and the overhead small.
BLOCK_ROWS = 4096


#: Singular values below this share of the largest are rounding: noise-free data have exact dependencies.
_RANK = 1e-11


def triangle(rows: FloatArray) -> FloatArray:
    """Return the upper triangular factor of the QR decomposition."""
    return np.asarray(qr(rows, mode="raw", check_finite=False)[1], dtype=np.float64)


def least_squares(regressors: FloatArray, targets: FloatArray) -> FloatArray:
    """Return the minimum-norm solution of regressors @ theta = targets, directions without data left at zero.

    Parameters
    ----------
    regressors : (N, P) array
        One column a parameter.
    targets : (N,) or (N, K) array
        What they explain.

    Returns
    -------
    (P,) or (P, K) array
        theta.
    """
    return np.asarray(np.linalg.lstsq(regressors, targets, rcond=_RANK)[0], dtype=np.float64)


def lagged_rows(signals: Sequence[tuple[FloatArray, Sequence[int]]], start: int, stop: int) -> FloatArray:
    """Return the rows ``start <= t < stop`` of the lagged data.

    Parameters
    ----------
    signals : sequence of (signal, offsets)
        Signal (N, channels) and the offsets k, in order, of the samples s(t + k) that make its columns.
    start, stop : int
        Range of t; every t + k must lie in the signal.

    Returns
    -------
    (stop - start, columns) array
        For each signal, for each offset, its channels.
    """
    width = sum(signal.shape[1] * len(offsets) for signal, offsets in signals)
    rows = np.empty((stop - start, width), order="F")
    at = 0
    for signal, offsets in signals:
        for k in offsets:
            rows[:, at : at + signal.shape[1]] = signal[start + k : stop + k]
            at += signal.shape[1]
    return rows


def lagged_range(signals: Sequence[tuple[FloatArray, Sequence[int]]]) -> tuple[int, int]:
    """Return the first t and the end of the range in which every lagged sample exists."""
    first = max(-min(offsets) for _, offsets in signals if len(offsets))
    end = min(len(signal) - max(offsets) for signal, offsets in signals if len(offsets))
    return max(first, 0), end


def lagged_factor(*stretches: Sequence[tuple[FloatArray, Sequence[int]]]) -> tuple[FloatArray, int]:
    """Return the upper triangular R of the QR decomposition of the lagged data about their means, and its rows.

    Every lag has a mean of its own over the rows: what is linear about any operating point is then exactly linear. The
    mean of the whole record taken from every lag leaves the ends of the record, a share of one in its length.

    Parameters
    ----------
    stretches : sequences of (signal, offsets)
        As in :func:`lagged_rows`; of several, the rows are stacked: none reaches over the gap between two.

    Returns
    -------
    R : (columns, columns) array
        R^T R is the sum of lagged products about the means; its transpose is the L of the papers' LQ (there: M).
    rows : int
        Number of rows j of the data.

    Raises
    ------
    IdentificationError
        Fewer rows than columns: the record is too short.
    """
    ranges = [lagged_range(signals) for signals in stretches]
    width = sum(signal.shape[1] * len(offsets) for signal, offsets in stretches[0])
    rows = sum(max(end - start, 0) for start, end in ranges)
    if rows <= width:
        raise IdentificationError(
            f"the record is too short: {rows} usable rows for {width} lagged columns",
            remedy="record longer, or ask for a lower order",
        )
    R = np.zeros((0, 1 + width))  # a row of ones comes first, and what lies along it goes
    step = max(BLOCK_ROWS, 4 * width)
    for signals, (start, end) in zip(stretches, ranges, strict=True):
        for at in range(start, end, step):
            lags = lagged_rows(signals, at, min(at + step, end))
            block = np.hstack([np.ones((len(lags), 1)), lags])
            R = triangle(np.vstack([R, block]) if len(R) else block)
    return R[1:, 1:], rows
