"""Stamps that fail, samples that fail, and change of value: what is left out, cut, or put on a grid, and said."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.files.cells import fill_forward

#: A gap this many usual steps long cuts a record, unless something else is asked for.
LONGEST_GAP_STEPS = 10.0
#: Stamps this much apart, the long steps from the short ones, come from recording on change.
_ON_CHANGE_RATIO = 4.0
_ON_CHANGE_SHARE = 0.1
_MOST_GRID_ROWS = 200_000
#: What a kind of step is judged by needs this many rows.
_FEWEST_STEPS = 30


def repair_stamps(columns: Mapping[str, FloatArray], notes: list[str]) -> dict[str, FloatArray]:
    """Leave out rows without a stamp and rows that repeat the stamp before them, or spread them where all do.

    Parameters
    ----------
    columns : mapping of str to (N,) array
        ``t`` and the signals.
    notes : list of str
        What was done is added.
    """
    known = np.isfinite(columns["t"])
    columns = {name: values[known] for name, values in columns.items()}
    t = columns["t"]
    repeats = np.concatenate([[False], np.diff(t) == 0.0])
    if (~known).any():
        notes.append(f"{int((~known).sum())} rows have no stamp and are left out")
    if repeats.sum() > 0.5 * t.size and t.size > _FEWEST_STEPS:
        notes.append("several rows share each stamp: they are taken as evenly spread until the next")
        return columns | {"t": _spread(t, repeats)}
    if repeats.any():
        notes.append(f"{int(repeats.sum())} rows repeat the stamp before them and are left out")
    return {name: values[~repeats] for name, values in columns.items()}


def _spread(t: FloatArray, repeats: BoolArray) -> FloatArray:
    """Return stamps of too few digits, the rows of each stamp spread evenly up to the next stamp."""
    first: IntArray = np.flatnonzero(~repeats)
    counts = np.diff(np.append(first, t.size))
    step = float(np.median(np.diff(t[first]))) / float(np.median(counts[1:-1] if counts.size > 2 else counts))
    begin, rank = np.repeat(t[first], counts), np.arange(t.size) - np.repeat(first, counts)
    if first.size > 1:  # the first stamp's rows may be the last of their second
        rank[: counts[0]] += max(int(np.median(counts)) - int(counts[0]), 0)
    return np.asarray(begin + rank * np.minimum(step, _room(t, first, counts)))


def _room(t: FloatArray, first: IntArray, counts: IntArray) -> FloatArray:
    """Return for each row the step that leaves the rows of its stamp before the next stamp [s]."""
    until = np.append(np.diff(t[first]), np.inf)
    until = np.where(until > 0.0, until, np.inf)
    return np.repeat(until / counts, counts)


def on_change(t: FloatArray, u: FloatArray, y: FloatArray) -> bool:
    """Return whether rows came when something had changed, not by the clock.

    Parameters
    ----------
    t : (N,) array
        Stamps [s].
    u, y : (N,) array
        NaN where a row has none.

    Notes
    -----
    Two signs: rows with u hardly ever have y and the other way round; or the steps between rows vary by a factor of
    four and more, one in ten of them. Missing rows alone make few long steps among equal ones.
    """
    if t.size < _FEWEST_STEPS:
        return False
    known_u, known_y = np.isfinite(u), np.isfinite(y)
    rarer = min(int(known_u.sum()), int(known_y.sum()))
    if rarer > 0 and (known_u & known_y).sum() < 0.1 * rarer:  # a slow analyser's rows have the command as well
        return True
    steps = np.diff(t)
    steps = steps[steps > 0.0]
    if steps.size < _FEWEST_STEPS:
        return False
    low, middle, high = np.percentile(steps, (5, 50, 95))
    varies = np.mean((steps < 0.5 * middle) | (steps > 2.0 * middle))
    return bool(high > _ON_CHANGE_RATIO * low and varies > _ON_CHANGE_SHARE)


def on_grid(columns: Mapping[str, FloatArray], notes: list[str]) -> dict[str, FloatArray]:
    """Return signals that were recorded on change, at even stamps: commands held, measurements between their values.

    Parameters
    ----------
    columns : mapping of str to (N,) array
        ``t`` rising, ``u``, ``y`` and others; NaN where a signal had not changed.
    notes : list of str
        What was done is added.

    Notes
    -----
    Between two values of y a straight line is within its dead band wherever y moved steadily; changes smaller than the
    dead band are not in the file, so the noise of y is not either.
    """
    t = columns["t"]
    steps = np.diff(t)
    span = float(t[-1] - t[0])
    dt = max(float(np.percentile(steps[steps > 0.0], 10)), span / _MOST_GRID_ROWS)
    dt = float(f"{dt:.2g}")
    start = max(float(t[np.argmax(np.isfinite(columns[name]))]) for name in ("u", "y"))
    grid = start + dt * np.arange(int((t[-1] - start) / dt + 1e-9) + 1)
    at = np.clip(np.searchsorted(t, grid + 1e-9 * dt, side="right") - 1, 0, None)
    notes.append(
        f"recorded on change of value: put on a grid of {dt:g} s, commands held, measurements joined by straight lines;"
        " what moved less than the dead band is not in it"
    )
    even: dict[str, FloatArray] = {"t": np.asarray(grid, dtype=np.float64)}
    for name, values in columns.items():
        if name == "y":
            known = np.isfinite(values)
            even[name] = np.asarray(np.interp(grid, t[known], values[known]), dtype=np.float64)
        elif name != "t":
            even[name] = fill_forward(values, ~np.isfinite(values))[at]
    return even


def stretches(t: FloatArray, good: BoolArray, longest_gap_s: float | None, notes: list[str]) -> list[IntArray]:
    """Return the good rows of each stretch, in which no gap between them is longer and no stamp goes back.

    Parameters
    ----------
    t : (N,) array
        Stamps [s].
    good : (N,) array of bool
        Rows with a usable command and measurement.
    longest_gap_s : float or None
        A longer gap cuts; ten usual steps when None.
    notes : list of str
        What was cut is added.
    """
    at: IntArray = np.flatnonzero(good)
    if at.size < 2:
        return [at]
    back = np.concatenate([[0], np.cumsum(np.diff(t) < 0.0)])
    steps = np.diff(t[at])
    longest = longest_gap_s or LONGEST_GAP_STEPS * float(np.median(np.abs(steps)))
    goes_back, gap = np.diff(back[at]) > 0, steps > longest
    for cut, what in ((goes_back, "stamps go back"), (gap & ~goes_back, f"a gap is longer than {longest:g} s")):
        if cut.any():
            notes.append(f"cut {int(cut.sum())} times where {what}")
    return np.split(at, np.flatnonzero(goes_back | gap) + 1)


def stretch(columns: Mapping[str, FloatArray], at: IntArray) -> dict[str, FloatArray]:
    """Return the rows from the first to the last good one.

    Parameters
    ----------
    columns : mapping of str to (N,) array
        t, u and y, and perhaps r and others; NaN where a row has none.
    at : (M,) array of int
        The good rows, ascending.

    Returns
    -------
    dict of str to array
        The same columns.

    Notes
    -----
    A row without a usable command is left out: the command before it is taken as held. So is a row without a usable y
    where the command stays as it was; where it changes, the row stays, with NaN.
    """
    span = slice(int(at[0]), int(at[-1]) + 1)
    part = {name: values[span] for name, values in columns.items()}
    part = {name: values[np.isfinite(part["u"])] for name, values in part.items()}
    tells = np.isfinite(part["y"]) | np.concatenate([[True], np.diff(part["u"]) != 0.0])
    part = {name: values[tells] for name, values in part.items()}
    if "r" in part:
        part["r"] = fill_forward(part["r"], ~np.isfinite(part["r"]))
    return part
