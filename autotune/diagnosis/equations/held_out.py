"""How wrong a model runs on what was not fitted: freely to the end of a recording, or as forecasts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray, IntArray
from autotune.diagnosis.evidence.stretches import FAR_OFF
from autotune.equations.fit_data import window_rows
from autotune.equations.sensitivity import Windows, run_windows
from autotune.equations.simulate import Compiled, Drive, simulate
from autotune.equations.starts import LEAST, fit_starts

#: Share of the recording that is kept for judging, and of that the share that a start state is found from.
HELD_OUT, SETTLED = 1.0 / 3.0, 0.15


def free_run(
    compiled: Compiled, p: FloatArray, drive: Drive, y: FloatArray, windows: Windows, row: int
) -> tuple[FloatArray, int]:  # fmt: skip
    """Return one free run from a row to the end, NaN before, and the row from which on it is judged.

    Its first part tells where it starts.
    """
    at = replace(_continued(compiled, p, drive, y, windows, row), stops=np.array([y.size]))
    return run_windows(compiled, p, drive, at).y, row + int(SETTLED * (y.size - row))


def _continued(compiled: Compiled, p: FloatArray, drive: Drive, y: FloatArray, before: Windows, row: int) -> Windows:
    """Return a window from a row to the end: what came before goes on, or rest, whatever the first readings fit better.

    From rest alone dry friction that holds a state would hide from the readings where that state is.
    """
    window = np.array([row]), np.array([y.size])
    return _started(compiled, p, drive, y, window, [_reached(compiled, p, drive, before, row)], SETTLED, LEAST)


def _reached(compiled: Compiled, p: FloatArray, drive: Drive, known: Windows, row: int) -> FloatArray | None:
    """Return the state that the last of known windows which begin before a row leads to there; else nothing."""
    k = np.flatnonzero(known.starts <= row)[-1:]
    if not k.size:
        return None
    state = simulate(compiled, p, drive, known.states[k], starts=known.starts[k], stops=np.array([row])).ends[0]
    return np.array(state) if np.all(np.isfinite(state)) else None


def _started(
    compiled: Compiled, p: FloatArray, drive: Drive, y: FloatArray, window: tuple[IntArray, IntArray],
    guesses: Sequence[FloatArray | None], share: float, least: int,
) -> Windows:  # fmt: skip
    """Return a window begun from rest, or from a guess, whatever the readings of a share of its rows fit better."""
    (at, end), good = window, np.isfinite(y)
    first, last = int(at[0]), int(at[0] + max(int(share * (end[0] - at[0])), 1))
    best, smallest = None, np.inf
    for guess in (None, *(one for one in guesses if one is not None)):
        w = fit_starts(compiled, p, drive, y, good, at, end, guess=guess, share=share, least=least)
        e = (y - run_windows(compiled, p, drive, replace(w, stops=np.array([last]))).y)[first:last]
        left = float(np.nansum(e**2)) if np.all(np.isfinite(e[good[first:last]])) else np.inf
        if best is None or left < smallest:
            best, smallest = w, left
    assert best is not None
    return best


def forecasts(
    compiled: Compiled, p: FloatArray, drive: Drive, y: FloatArray, windows: Windows, row: int, horizon_s: float
) -> tuple[FloatArray, int]:  # fmt: skip
    """Return forecasts, each from a state that the horizon before it tells, and the row that the first begins at."""
    edges, _ = window_rows(drive.t, horizon_s)
    edges = np.append(edges, y.size)
    found, first = np.full(y.size, np.nan), y.size
    for before, a, b in zip(edges, edges[1:], edges[2:], strict=False):
        if a < row:
            continue
        guess = _reached(compiled, p, drive, windows, int(before))
        share, window = (a - before) / (b - before), (np.array([before]), np.array([b]))
        windows = _started(compiled, p, drive, y, window, [guess], share, int(a - before))
        found[a:b] = run_windows(compiled, p, drive, windows).y[a:b]
        first = min(first, int(a))
    return found, first


def bounded_errors(y: FloatArray, run: FloatArray, first: int) -> FloatArray:
    """Return a run's errors from a row on, no larger than a bound: where it runs away, how far does not matter."""
    most, e = FAR_OFF * float(np.nanstd(y)), y - run
    away = np.isfinite(y) & ~np.isfinite(e)
    return np.asarray(np.clip(np.where(away, most, e), -most, most)[first:])


def until(w: Windows, row: int) -> Windows:
    """Return the windows that begin before a row, the last one cut there."""
    keep = w.starts < row - 20
    return replace(w, starts=w.starts[keep], stops=np.minimum(w.stops[keep], row), states=w.states[keep])
