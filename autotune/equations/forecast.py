"""Simulation of equations against a recording: a free run, or forecasts from states estimated from the past alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.effects import apply
from autotune.equations.model import EquationModel
from autotune.equations.rest import input_sizes, rest_state, state_scales, stated_starts
from autotune.equations.sensitivity import Windows, run_windows
from autotune.equations.simulate import Compiled, Drive, compile_model, drive_of, require_complete, simulate
from autotune.equations.starts import fit_starts
from autotune.errors import InputError
from autotune.forecasts import Forecaster
from autotune.recording import Recording


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
    of = Forecaster(plant=_plant(compiled, drive, recording), recording=recording)
    return applied.after(of.windows(horizon_s))


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


@dataclass(frozen=True, kw_only=True, eq=False)
class _Equations:
    """Equations as :class:`autotune.forecasts.Plant` has them; their first input is the command."""

    compiled: Compiled
    drive: Drive
    sizes: FloatArray
    force_size: float
    given: FloatArray
    is_linear: bool = False
    linear: None = None

    def rest(self, row: int, reading: float) -> FloatArray:
        """See there."""
        return rest_state(self.compiled, self.compiled.parameter_vector, self.drive.inputs[max(row - 1, 0)], reading)

    def run(self, first: int, last: int, state: FloatArray, force: float) -> tuple[FloatArray, FloatArray]:
        """See there."""
        if first == 0:
            state = np.where(np.isfinite(self.given), self.given, state)
        drive = self.drive
        if force:
            drive = replace(drive, inputs=drive.inputs + force * np.eye(1, drive.inputs.shape[1]))
        windows = Windows(starts=np.array([first]), stops=np.array([last]), states=state[None, :])
        run = run_windows(self.compiled, self.compiled.parameter_vector, drive, windows)
        return run.y[first:last], run.ends[0]


def _plant(compiled: Compiled, drive: Drive, recording: Recording) -> _Equations:
    p, y = compiled.parameter_vector, recording.y
    start = rest_state(compiled, p, drive.inputs[0], float(y[np.isfinite(y)][0]))
    return _Equations(
        compiled=compiled,
        drive=drive,
        sizes=state_scales(compiled, p, drive, start),
        force_size=float(np.std(drive.inputs[:, 0])) or float(input_sizes(compiled, drive.inputs[0])[0]),
        given=stated_starts(compiled),
    )
