"""What a fit works on, windows of recordings, and what it finds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.equations.sensitivity import Windows
from autotune.equations.simulate import Compiled, Drive, drive_of
from autotune.equations.starts import fit_starts
from autotune.errors import InputError
from autotune.recording import Recording

#: Share of a window by which windows may be longer than what was asked for, so that no short rest is left.
LONGER = 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """What a fit found.

    Attributes
    ----------
    compiled : Compiled
        The model.
    parameters, sd : (P,) arrays
        Estimates, and their standard deviations with the beliefs counted; 0 for what is not retuned.
    z : (P,) array
        Distance from the nominal values in prior standard deviations.
    windows : tuple of Windows
        Start states, one entry per recording.
    simulated : tuple of (N,) array
        y at every row.
    residuals : tuple of (N,) array
        Reading less simulation; NaN where the reading does not count.
    noise_sd : float
        Root mean square of the residuals [y unit].
    jacobian : (rows, P) array
        dy/dz over the noise where the last step began, start states projected out; see
        :mod:`autotune.equations.identifiability`.
    """

    compiled: Compiled
    parameters: FloatArray
    sd: FloatArray
    z: FloatArray
    windows: tuple[Windows, ...]
    simulated: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    noise_sd: float
    jacobian: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class FitData:
    """A recording prepared for a fit."""

    drive: Drive
    y: FloatArray
    good: BoolArray
    windows: Windows


def window_rows(t: FloatArray, horizon_s: float | None) -> tuple[IntArray, IntArray]:
    """Return the first rows of windows of about a length, and the rows before which they end; one window without it.

    All are as long as one another: in a longer one an unstable plant would run away.

    Parameters
    ----------
    t : (N,) array
        Time stamps [s].
    horizon_s : float or None
        The length [s].

    Returns
    -------
    tuple of (W,) array of int
        First rows, and stop rows.
    """
    if horizon_s is None:
        return np.zeros(1, dtype=np.int64), np.array([t.size], dtype=np.int64)
    span = float(t[-1] - t[0])
    count = max(int(np.ceil(span / horizon_s - LONGER)), 1)
    edges = np.searchsorted(t, t[0] + span / count * np.arange(count) - 1e-9 * horizon_s).astype(np.int64)
    edges = np.unique(edges)
    return edges, np.append(edges[1:], t.size)


def data_of(
    compiled: Compiled, recording: Recording, parameters: FloatArray, length_s: float | None, windows: Windows | None,
    known: Windows | None = None,
) -> FitData:  # fmt: skip
    """Return a recording prepared for a fit, on given windows or on ones of a length.

    What an earlier fit knows of states, on its own windows, is taken over.

    Parameters
    ----------
    compiled : Compiled
        The model.
    recording : Recording
        N rows.
    parameters : (P,) array
        Values that the start states are estimated with.
    length_s : float or None
        Length of the windows [s]; one window when None.
    windows : Windows or None
        The windows, where they are known.
    known : Windows, optional
        Of an earlier fit.

    Raises
    ------
    InputError
        Fewer than 8 readings that count.
    """
    drive, good = drive_of(compiled.model, recording), np.isfinite(recording.y)
    if good.sum() < 8:
        raise InputError("fewer than 8 finite readings", where=recording.name, remedy="record longer")
    if windows is None:
        first = 0 if compiled.model.has_given_start else recording.first_reading
        starts, stops = (rows + first for rows in window_rows(recording.t[first:], length_s))
        read = np.add.reduceat(good, starts) > 0  # a window without a reading tells nothing
        starts, stops = starts[read], stops[read]
        windows = fit_starts(compiled, parameters, drive, recording.y, good, starts, stops, known=known)
    return FitData(drive=drive, y=recording.y, good=good, windows=windows)


def mean_squares(one: FitData, w: Windows, y: FloatArray) -> FloatArray:
    """Return the mean square that each window leaves of what was simulated; infinite where it runs away.

    Parameters
    ----------
    one : FitData
        A recording of N rows.
    w : Windows
        W windows of it.
    y : (N,) array
        What was simulated on them [y unit].

    Returns
    -------
    (W,) array
        In the reading's unit squared.
    """
    e = one.y - y
    parts = (e[a:b][one.good[a:b]] for a, b in zip(w.starts, w.stops, strict=True))
    found = [float(np.mean(part**2)) if part.size else 0.0 for part in parts]
    return np.where(np.isfinite(found), found, np.inf)


def covered_rows(rows: int, w: Windows) -> BoolArray:
    """Return which of so many rows lie in a window, a bool array of that length.

    Parameters
    ----------
    rows : int
        Rows of the recording.
    w : Windows
        Windows of it.
    """
    covered = np.zeros(rows, dtype=bool)
    for a, b in zip(w.starts, w.stops, strict=True):
        covered[a:b] = True
    return covered
