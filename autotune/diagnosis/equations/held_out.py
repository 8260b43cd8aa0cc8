"""How wrong a model runs on what was not fitted: freely to the end of a recording, or as forecasts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.fit_data import window_rows
from autotune.equations.sensitivity import Windows, run_windows
from autotune.equations.simulate import Compiled, Drive, simulate
from autotune.equations.starts import fitted_starts

#: Spreads of y that an error counts at most: a simulation that runs away is that wrong.
FAR_OFF = 10.0
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
    at, end, good = np.array([row]), np.array([y.size]), np.isfinite(y)
    until = np.array([row + max(int(SETTLED * (y.size - row)), 1)])
    guesses: list[FloatArray | None] = [None]
    if before.starts.size:
        run = simulate(compiled, p, drive, before.states[-1:], starts=before.starts[-1:], stops=at)
        guesses += [run.ends[0]] if np.all(np.isfinite(run.ends)) else []
    best, least = None, np.inf
    for guess in guesses:
        w = fitted_starts(compiled, p, drive, y, good, at, end, guess=guess, share=SETTLED)
        e = (y - run_windows(compiled, p, drive, replace(w, stops=until)).y)[at[0] : until[0]]
        left = float(np.nansum(e**2)) if np.all(np.isfinite(e[good[at[0] : until[0]]])) else np.inf
        if best is None or left < least:
            best, least = w, left
    assert best is not None
    return best


def forecasts(
    compiled: Compiled, p: FloatArray, drive: Drive, y: FloatArray, row: int, horizon_s: float
) -> tuple[FloatArray, int]:  # fmt: skip
    """Return forecasts, each from a state that the horizon before it tells, and the row that the first begins at."""
    edges, _ = window_rows(drive.t, horizon_s)
    edges = np.append(edges, y.size)
    found, first, guess = np.full(y.size, np.nan), y.size, None
    for before, a, b in zip(edges, edges[1:], edges[2:], strict=False):
        if a < row:
            continue
        w = fitted_starts(
            compiled, p, drive, y, np.isfinite(y), np.array([before]), np.array([b]), share=(a - before) / (b - before),
            least=int(a - before), guess=guess,
        )  # fmt: skip
        found[a:b] = run_windows(compiled, p, drive, w).y[a:b]
        now = run_windows(compiled, p, drive, replace(w, stops=np.array([a]))).ends[0]
        guess, first = now if np.all(np.isfinite(now)) else None, min(first, int(a))
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
