"""Linearisation of equations at an operating point: state space, transfer function, a chain of one block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.effects import apply
from autotune.equations.model import EquationModel
from autotune.equations.simulate import Compiled, compile_model, derivatives
from autotune.equations.starts import rest_state
from autotune.errors import InputError
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

#: Relative step of the central differences.
_STEP = 1e-5


@dataclass(frozen=True, kw_only=True, eq=False)
class Linear:
    """dx/dt = A x + B w, y = C x + D w about a point: x, inputs w and y as deviations from it.

    Attributes
    ----------
    A, B, C, D : arrays
        (n, n), (n, m), (1, n), (1, m).
    states, inputs : (n,), (m,) arrays
        The operating point.
    y : float
        The reading there.
    delays_s : (m,) array
        Dead time of each input, which the matrices do not hold.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    states: FloatArray
    inputs: FloatArray
    y: float
    delays_s: FloatArray


def linearise(model: EquationModel, inputs: FloatArray, y: float = float("nan")) -> Linear:
    """Linearise a model with its effects at rest under inputs.

    Parameters
    ----------
    model : EquationModel
        The model.
    inputs : (m,) array
        Inputs of the operating point.
    y : float
        The reading there, where several rests are possible (an integrating plant).

    Returns
    -------
    Linear
        Central differences; switched terms are on the side they are on at rest.

    Raises
    ------
    InputError
        No rest is found under these inputs.
    """
    applied = apply(model)
    compiled = compile_model(model, applied.extensions)
    p = compiled.parameter_vector
    x = rest_state(compiled, p, inputs, y)
    slopes, outputs = derivatives(compiled, p, x[None, :], inputs[None, :])
    probe = np.abs(_differences(compiled, p, x, inputs)[0]) @ (np.abs(x) + 1e-3)
    if not np.all(np.isfinite(slopes)) or np.any(np.abs(slopes[0]) > 1e-4 * (probe + 1.0)):
        raise InputError("no rest is found under these inputs", where=model.name,
                         remedy="give inputs, and y where the plant integrates, at which it can rest")  # fmt: skip
    A, B, C, D = _differences(compiled, p, x, inputs)
    return Linear(A=A, B=B, C=C, D=D, states=x, inputs=inputs, y=float(outputs[0, 0]), delays_s=applied.delays)


def growth_rate(model: EquationModel, recordings: Sequence[Recording]) -> float:
    """Return the rate at which a deviation from where recordings are grows [1/s]: 0 of a stable plant.

    Parameters
    ----------
    model : EquationModel
        The model.
    recordings : sequence of Recording
        Their medians are the operating point; where nothing rests under these inputs the rate is not known, and 0.
    """
    linear = _at_recordings(model, recordings)
    return 0.0 if linear is None else max(float(np.max(np.linalg.eigvals(linear.A).real, initial=0.0)), 0.0)


def settles(model: EquationModel, recordings: Sequence[Recording]) -> bool:
    """Whether a deviation from where recordings are dies out, as far as a rest is known there.

    Parameters
    ----------
    model : EquationModel
        The model.
    recordings : sequence of Recording
        Say where it rests.
    """
    linear = _at_recordings(model, recordings)
    return linear is not None and bool(np.all(np.linalg.eigvals(linear.A).real < 0.0))


def linearise_at(model: EquationModel, states: FloatArray, inputs: FloatArray) -> Linear:
    """Linearise a model about any point, whether it rests there or not.

    Parameters
    ----------
    model : EquationModel
        The model; of its effects those without a memory act.
    states, inputs : (n,), (m,) arrays
        Where.
    """
    applied = apply(model)
    compiled = compile_model(model, applied.extensions)
    p = compiled.parameter_vector
    A, B, C, D = _differences(compiled, p, states, inputs)
    y = float(derivatives(compiled, p, states[None, :], inputs[None, :])[1][0, 0])
    return Linear(A=A, B=B, C=C, D=D, states=states, inputs=inputs, y=y, delays_s=applied.delays)


def _at_recordings(model: EquationModel, recordings: Sequence[Recording]) -> Linear | None:
    """Return a model linearised at the medians of recordings; nothing where nothing rests there."""
    inputs = np.array([float(np.median(np.concatenate([r[name] for r in recordings]))) for name in model.columns])
    y = float(np.nanmedian(np.concatenate([r.y for r in recordings])))
    for near in (float("nan"), y):
        try:
            return linearise(model, inputs, near)
        except InputError:
            continue
    return None


def _differences(
    compiled: Compiled, p: FloatArray, x: FloatArray, inputs: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    n, m = x.size, inputs.size
    point = np.concatenate([x, inputs])
    steps = _STEP * np.maximum(np.abs(point), 1.0)
    points = np.concatenate([point + np.diag(steps), point - np.diag(steps)])
    slopes, outputs = derivatives(compiled, p, points[:, :n], points[:, n:])
    J = ((slopes[: n + m] - slopes[n + m :]) / (2.0 * steps[:, None])).T
    g = ((outputs[: n + m, :1] - outputs[n + m :, :1]) / (2.0 * steps[:, None])).T
    return J[:, :n], J[:, n:], g[:, :n], g[:, n:]


def transfer_function(linear: Linear) -> TransferFunction:
    """Return the transfer function from the command to y, with its dead time."""
    from scipy.signal import ss2tf

    num, den = ss2tf(linear.A, linear.B[:, :1], linear.C, linear.D[:, :1])
    kept = np.where(np.abs(num[0]) > 1e-9 * np.max(np.abs(num[0])), num[0], 0.0)
    return TransferFunction(num=tuple(kept), den=tuple(den), delay_s=float(linear.delays_s[0]))


def as_chain(model: EquationModel, linear: Linear) -> Model:
    """Return the linearisation from the command as a chain of one block, offsets at the operating point.

    Parameters
    ----------
    model : EquationModel
        Names and units.
    linear : Linear
        Its linearisation.
    """
    block = Block(name="linearisation", place="plant", dynamics=transfer_function(linear))
    return Model(
        name=f"{model.name}, linearised",
        input=Port(unit=model.inputs[0].unit, offset=float(linear.inputs[0]), hold=model.inputs[0].hold),
        output=Port(unit=model.output_unit, offset=linear.y),
        blocks=(block,),
    )
