"""Simulation of a chain against a recording: a free run, or forecasts from states estimated from the past alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.simulation.assembly import assemble, input_size, spans_of
from autotune.diagnosis.simulation.simulator import Simulator, Windows
from autotune.effects import kind_of
from autotune.errors import InputError
from autotune.forecasts import Forecaster
from autotune.models import Model
from autotune.recording import Recording


@dataclass(frozen=True, kw_only=True, eq=False)
class _Chain:
    """A chain as :class:`autotune.forecasts.Plant` has it."""

    sim: Simulator
    recording: Recording
    sizes: FloatArray
    force_size: float
    dt_s: float

    @property
    def is_linear(self) -> bool:
        """See there."""
        return self.sim.is_linear

    @cached_property
    def linear(self) -> _Chain:
        """See there."""
        return replace(self, sim=self.sim.linear())

    def rest(self, row: int, reading: float) -> FloatArray:
        """See there."""
        return self.sim.rest_state(float(self.recording.u[max(row - 1, 0)]), reading, self.dt_s)

    def run(self, first: int, last: int, state: FloatArray, force: float) -> tuple[FloatArray, FloatArray]:
        """See there."""
        sim = replace(self.sim, u_offset=self.sim.u_offset + force) if force else self.sim
        window = Windows(starts=np.array([first], dtype=np.int64), stops=np.array([last], dtype=np.int64))
        out, ends = sim.run(self.recording, state, window, sample_time_s=self.dt_s, signals=1)
        return np.asarray(out[first:last, 0]), np.asarray(ends[0])


def forecast(model: Model, recording: Recording, horizon_s: float | None = None) -> FloatArray:
    """Simulate a model with a recording's u, its state taken from the recording's past.

    Parameters
    ----------
    model : Model
        Chain and effects.
    recording : Recording
        t, u and y; rows whose y is not a number do not count.
    horizon_s : float, optional
        Length of the windows [s] at whose starts the state is estimated anew; without it the state is estimated from
        the first tenth of the rows and everything runs free from there.

    Returns
    -------
    (N,) array
        Simulated y. The first window has no past: its state is fitted to its own rows.

    Raises
    ------
    InputError
        A horizon shorter than two samples, u that is not finite, or no finite y.
    """
    recording.require_finite(("u",))
    if any(kind_of(effect.name).late_stamps for effect in model.effects):
        recording = recording.at_even_times()  # the model says that stamps are wrong and samples even
    good = np.isfinite(recording.y)
    if good.sum() < 8:
        raise InputError("fewer than 8 finite readings", where=recording.name, remedy="record longer")
    full = assemble(model)
    # no derivative leads through a converter's steps: states are estimated without them
    sim = full.without_steps()
    plant = _Chain(
        sim=sim,
        recording=recording,
        sizes=sim.state_sizes(*spans_of([recording.u], [recording.y[good]]), recording.sample_time_s),
        force_size=input_size(model, [recording]),
        dt_s=recording.sample_time_s,
    )
    of = Forecaster(plant=plant, recording=recording)
    if horizon_s is not None:
        return full.stepped(of.windows(horizon_s))
    rows = max(len(recording) // 10, min(len(recording), 8))
    return full.stepped(of.run(0, len(recording), of.estimate(0, rows)))
