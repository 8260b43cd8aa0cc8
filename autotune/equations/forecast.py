"""Simulation of equations against a recording: a free run, or forecasts from states estimated from the past alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.effects import apply
from autotune.equations.model import EquationModel
from autotune.equations.sensitivity import Windows, run_windows
from autotune.equations.simulate import Compiled, Drive, compile_model, drive_of, require_complete, simulate
from autotune.equations.starts import LEAST, fit_starts
from autotune.errors import InputError
from autotune.recording import Recording

#: Past used for a state, in horizons; the one that forecast earlier windows best is taken.
PASTS = (0.25, 1.0, 3.0)
#: How fast old forecasts lose their say in which past is used, per window.
MEMORY = 0.9


def forecast(model: EquationModel, recording: Recording, horizon_s: float | None = None) -> FloatArray:
    """Simulate a model with a recording's inputs.

    Parameters
    ----------
    model : EquationModel
        Equations with their effects.
    recording : Recording
        Inputs and readings; rows whose y is no number do not count.
    horizon_s : float, optional
        Length of the windows [s] at whose starts the state is estimated anew from past readings; by default the
        state is estimated from the first tenth of the rows and everything runs free from there.

    Returns
    -------
    (N,) array
        Simulated y. The first window has no past: its state is fitted to its own rows.

    Raises
    ------
    InputError
        A missing column, fewer than 8 readings, a horizon shorter than two samples, or a simulation that runs away.
    """
    applied = apply(model)
    compiled = compile_model(model, applied.extensions)
    compiled = _add_delays(compiled, applied.delays)
    drive, good = applied.before(drive_of(model, recording)), np.isfinite(recording.y)
    if good.sum() < 8:
        raise InputError("fewer than 8 finite readings", where=recording.name, remedy="record longer")
    if horizon_s is None:
        return applied.after(_free_run(compiled, drive, recording))
    if not horizon_s >= 2.0 * recording.sample_time_s:
        raise InputError(f"horizon = {horizon_s:g} s", where="--horizon", remedy="give at least two sample times")
    return applied.after(_forecast_windows(compiled, drive, recording, horizon_s))


def _add_delays(compiled: Compiled, delays: FloatArray) -> Compiled:
    """Return the model with dead times at its inputs."""
    inputs = tuple(replace(one, delay_s=float(d)) for one, d in zip(compiled.model.inputs, delays, strict=True))
    return replace(compiled, model=replace(compiled.model, inputs=inputs))


def _free_run(compiled: Compiled, drive: Drive, recording: Recording) -> FloatArray:
    y, good = recording.y, np.isfinite(recording.y)
    first, last = np.zeros(1, dtype=np.int64), np.array([len(recording)])
    windows = fit_starts(compiled, compiled.parameter_vector, drive, y, good, first, last)
    run = simulate(compiled, compiled.parameter_vector, drive, windows.states)
    return require_complete(run, compiled, recording.name).y


def _forecast_windows(compiled: Compiled, drive: Drive, recording: Recording, horizon_s: float) -> FloatArray:
    """Forecast window by window; each past is a filter of its own that carries its state along."""
    t, y, good = recording.t, recording.y, np.isfinite(recording.y)
    count = int(np.floor((t[-1] - t[0]) / horizon_s + 1e-9)) + 1
    edges = np.searchsorted(t, t[0] + horizon_s * np.arange(count + 1) - 1e-9 * horizon_s).astype(np.int64)
    edges[-1] = t.size
    p = compiled.parameter_vector
    result = np.full(t.size, np.nan)
    errors = np.zeros(len(PASTS))
    before: Windows | None = None
    for k in range(count):
        a, b = int(edges[k]), int(edges[k + 1])
        if a == b:
            continue
        forecasts = []
        for past in PASTS if k else (0.0,):
            start = max(min(int(np.searchsorted(t, t[a] - past * horizon_s)), a - LEAST), 0) if k else 0
            until = a if k else b
            guess = None if before is None else _carry_state(compiled, drive, before, start)
            window = fit_starts(
                compiled, p, drive, y, good, np.array([start]), np.array([until]), guess=guess, share=1.0, iterations=5
            )
            latest = replace(window, stops=np.array([b]))
            forecasts.append(run_windows(compiled, p, drive, latest).y[a:b])
        before = latest
        best = int(np.argmin(errors)) if k > 2 else len(forecasts) - 1
        result[a:b] = forecasts[min(best, len(forecasts) - 1)]
        if k:
            ok = good[a:b]
            new = np.array([float(np.sum((y[a:b] - f)[ok] ** 2)) for f in forecasts])
            errors = MEMORY * errors + np.where(np.isfinite(new), new, 1e300)
    if not np.all(np.isfinite(result)):
        raise InputError("a forecast runs away", where=recording.name, remedy="give a shorter --horizon")
    return result


def _carry_state(compiled: Compiled, drive: Drive, before: Windows, row: int) -> FloatArray | None:
    """Return the state that an earlier window leads to at a row, where it starts before it."""
    a = int(before.starts[0])
    if a >= row:
        return before.states[0] if a == row else None
    run = run_windows(compiled, compiled.parameter_vector, drive, replace(before, stops=np.array([row])))
    return run.ends[0] if np.all(np.isfinite(run.ends)) else None
