"""Models whose inside is closed: an FMU, or a person's own step function, driven by recordings and retuned.

What happens inside is not seen, so effects act on inputs and on the reading; forces and flows that the model offers
as further inputs take loads. Parameters are retuned by finite differences.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.effects import apply, at_reading
from autotune.equations.expressions import Name
from autotune.equations.model import EquationModel, Extension, InputColumn, ModelParameter, State
from autotune.equations.simulate import Drive, compile_model, simulate
from autotune.models import Effect
from autotune.recording import Recording


class Simulation(Protocol):
    """What runs a closed model once over a recording."""

    def __call__(self, parameters: Mapping[str, float], drive: Drive, /) -> FloatArray:
        """Return y at the drive's rows, (N,); a row's reading comes before its inputs act."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class BlackBox:
    """A closed model.

    Attributes
    ----------
    name : str
        What it is.
    inputs : tuple of InputColumn
        Columns that drive it; those with a ``kind`` take forces or flows.
    parameters : tuple of ModelParameter
        What may be retuned.
    simulation : Simulation
        Runs it.
    output_unit : str
        Unit of y.
    effects : tuple of Effect
        What a diagnosis added.
    source : mapping
        Further entries of its model file (the FMU's path, the output's name).
    """

    name: str
    inputs: tuple[InputColumn, ...]
    parameters: tuple[ModelParameter, ...]
    simulation: Simulation
    output_unit: str = ""
    effects: tuple[Effect, ...] = ()
    source: Mapping[str, Any] = None  # type: ignore[assignment]

    @property
    def signal_units(self) -> dict[str, str]:
        """Units of the columns that drive it, and of y."""
        return {one.column: one.unit for one in self.inputs} | {"y": self.output_unit}

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the recording that drive it."""
        return tuple(one.column for one in self.inputs)

    def shell(self) -> EquationModel:
        """Return equations with the same inputs and nothing inside: what effects on the inputs are written in."""
        return EquationModel(
            name=self.name, inputs=self.inputs, output=Name(self.columns[0]), parameters=(), effects=self.effects,
            states=(State(name="nothing", derivative=Name("nothing"), start=0.0),),
        )  # fmt: skip


def driven(box: BlackBox, extensions: Sequence[Extension], delays: FloatArray, drive: Drive) -> Drive:
    """Return the inputs that reach a closed model behind effects on its inputs.

    Parameters
    ----------
    box : BlackBox
        The closed model.
    extensions : sequence of Extension
        Effects on its inputs.
    delays : (m,) array
        Dead time of each input [s].
    drive : Drive
        N rows of m inputs.

    Returns
    -------
    Drive
        The same rows, with what arrives.

    Notes
    -----
    A row's input is the mean of what arrives until the next row: exact for what acts at once, and to the second order
    of the rows' distance for lags, dead times and rate limits.
    """
    shell = replace(
        box.shell(), inputs=tuple(replace(one, delay_s=float(d)) for one, d in zip(box.inputs, delays, strict=True))
    )
    integrals = tuple(State(name=f"integral_{c}", derivative=Name(c), start=0.0) for c in box.columns)
    whole = replace(shell, states=integrals)
    compiled = compile_model(whole, extensions, [f"integral_{c}" for c in box.columns])
    start = np.zeros((1, len(compiled.states)))
    for i, name in enumerate(compiled.states):
        if name.endswith("memory"):
            start[0, i] = drive.inputs[0, 0] - box.inputs[0].offset
    run = simulate(compiled, compiled.parameter_vector, drive, start)
    sums = run.outputs[:, 1:]
    arrived = np.diff(sums, axis=0) / np.diff(drive.t)[:, None]
    return Drive(t=drive.t, inputs=np.vstack([arrived, arrived[-1:]]))


def from_function(
    step: Callable[[Any, FloatArray, Mapping[str, float], float], tuple[Any, float]],
    state: Any,
    parameters: Mapping[str, float],
    *,
    columns: Sequence[str] = ("u",),
    name: str = "function",
    spread: float = 0.3,
) -> BlackBox:
    """Return a person's step function as a model.

    Parameters
    ----------
    step : callable
        ``step(state, inputs, parameters, dt_s) -> (next_state, y)`` with y before the inputs act; (m,) inputs.
    state : any
        State at the first row; it is copied for every run.
    parameters : mapping of str to float
        What may be retuned, with nominal values.
    columns : sequence of str
        Columns of the recording that make the inputs.
    name : str
        What it is.
    spread : float
        Relative prior standard deviation of the parameters.

    Returns
    -------
    BlackBox
        It is called once per row and parameter set.
    """
    from copy import deepcopy

    def simulation(values: Mapping[str, float], drive: Drive) -> FloatArray:
        y, now = np.empty(drive.t.size), deepcopy(state)
        dt = np.append(np.diff(drive.t), drive.t[-1] - drive.t[-2])
        for k in range(drive.t.size):
            now, y[k] = step(now, drive.inputs[k], values, float(dt[k]))
        return y

    return BlackBox(
        name=name, inputs=tuple(InputColumn(column=c) for c in columns), simulation=simulation, source={},
        parameters=tuple(ModelParameter(name=n, value=float(v), spread=spread) for n, v in parameters.items()),
    )  # fmt: skip


def read_out(y: FloatArray, drive: Drive, effects: Sequence[Effect]) -> FloatArray:
    """Return readings behind effects of the sensor, the signal straight between rows.

    Parameters
    ----------
    y : (N,) array
        What the model gives [y unit].
    drive : Drive
        Its rows.
    effects : sequence of Effect
        Of the sensor.

    Returns
    -------
    (N,) array
        Readings [y unit].
    """
    if not effects:
        return y
    shell = EquationModel(name="sensor", inputs=(InputColumn(column="z", hold="linear"),), output=Name("z"), states=())
    compiled = compile_model(shell, apply(shell, effects).extensions)
    start = np.array([[y[0] if name.endswith("memory") else 0.0 for name in compiled.states]])
    return simulate(compiled, compiled.parameter_vector, Drive(t=drive.t, inputs=y[:, None].copy()), start).y


def run_closed(box: BlackBox, recording: Recording) -> FloatArray:
    """Return the readings of a closed model with its effects over a recording, from the model's own start.

    Parameters
    ----------
    box : BlackBox
        The closed model.
    recording : Recording
        N rows, with its input columns.

    Returns
    -------
    (N,) array
        Readings [y unit].

    Raises
    ------
    InputError
        A missing column, or what the model itself raises.
    """
    recording.require_finite(box.columns)
    drive = Drive(t=recording.t, inputs=np.column_stack([recording[c] for c in box.columns]))
    shell = box.shell()
    applied = apply(shell)
    at_input = [one for one in applied.extensions if one.output is None]
    arriving = driven(box, at_input, applied.delays, applied.before(drive))
    y = box.simulation({p.name: p.value for p in box.parameters}, arriving)
    return applied.after(read_out(y, drive, at_reading(shell, box.effects)))
