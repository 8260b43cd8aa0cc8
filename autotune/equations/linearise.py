"""Linearisation of equations at an operating point: state space, transfer function, a chain of one block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.effects import apply
from autotune.equations.model import EquationModel
from autotune.equations.rest import input_sizes, rest_state, typical_sizes
from autotune.equations.simulate import Compiled, compile_model, derivatives
from autotune.errors import InputError
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

#: Step of the central differences, in sizes of what is changed; and slope below which a state rests, in sizes in the
#: time of the fastest.
_STEP, _AT_REST = 1e-5, 1e-4


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


def linearise(
    model: EquationModel, inputs: FloatArray, y: float = float("nan"), spread: FloatArray | None = None
) -> Linear:
    """Linearise a model with its effects at rest under inputs.

    Parameters
    ----------
    model : EquationModel
        The model.
    inputs : (m,) array
        Inputs of the operating point.
    y : float
        The reading there, where several rests are possible (an integrating plant).
    spread : (m,) array, optional
        How far the inputs go from there, where that is known: what is small against it counts as rounding.

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
    slopes = derivatives(compiled, p, x[None, :], inputs[None, :])[0][0]
    kick = input_sizes(compiled, inputs if spread is None else np.maximum(np.abs(inputs), spread))
    sizes, time_s = typical_sizes(compiled, p, inputs, x, kick)
    if not np.all(np.isfinite(slopes)) or np.any(np.abs(slopes) * time_s > _AT_REST * sizes):
        raise InputError("no rest is found under these inputs", where=model.name,
                         remedy="give inputs, and y where the plant integrates, at which it can rest")  # fmt: skip
    return _tangent(compiled, x, inputs, kick, applied.delays)


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
    return _tangent(compiled, states, inputs, input_sizes(compiled, inputs), applied.delays)


def _at_recordings(model: EquationModel, recordings: Sequence[Recording]) -> Linear | None:
    """Return a model linearised at the medians of recordings; nothing where nothing rests there."""
    columns = [np.concatenate([r[name] for r in recordings]) for name in model.columns]
    inputs = np.array([float(np.median(one)) for one in columns])
    spread = np.array([float(np.ptp(one)) for one in columns])
    y = float(np.nanmedian(np.concatenate([r.y for r in recordings])))
    for near in (float("nan"), y):
        try:
            return linearise(model, inputs, near, spread)
        except InputError:
            continue
    return None


def _tangent(compiled: Compiled, x: FloatArray, inputs: FloatArray, kick: FloatArray, delays_s: FloatArray) -> Linear:
    """Return the tangent at a point by central differences; ``kick`` is how large the inputs are."""
    n, p = x.size, compiled.parameter_vector
    sizes = typical_sizes(compiled, p, inputs, x, kick)[0]
    steps = _STEP * np.concatenate([np.where(sizes > 0.0, sizes, 1.0), kick])
    point = np.concatenate([x, inputs])
    points = np.concatenate([point[None, :], point + np.diag(steps), point - np.diag(steps)])
    slopes, outputs = derivatives(compiled, p, points[:, :n], points[:, n:])
    up, down = slice(1, 1 + steps.size), slice(1 + steps.size, None)
    J = ((slopes[up] - slopes[down]) / (2.0 * steps[:, None])).T
    g = ((outputs[up, :1] - outputs[down, :1]) / (2.0 * steps[:, None])).T
    return Linear(
        A=J[:, :n], B=J[:, n:], C=g[:, :n], D=g[:, n:], states=x, inputs=inputs, y=float(outputs[0, 0]),
        delays_s=delays_s,
    )  # fmt: skip


def transfer_function(linear: Linear) -> TransferFunction:
    """Return the transfer function from the command to y, with its dead time."""
    from scipy.signal import ss2tf

    A, B, C = linear.A, linear.B[:, :1], linear.C
    # ss2tf subtracts two polynomials: what is told in small units would be lost in the digits of the other
    scales = _balance(np.block([[A, B], [C, np.zeros((1, 1))]]))
    x, port = scales[:-1], scales[-1]
    A, B, C = A * x / x[:, None], B * port / x[:, None], C * x / port
    gain = float(np.max(np.abs(C), initial=0.0) * np.max(np.abs(B), initial=0.0))
    gain = gain / (float(np.max(np.abs(A), initial=0.0)) or 1.0) or 1.0
    num, den = ss2tf(A, B, C / gain, linear.D[:, :1] / gain)
    kept = gain * np.where(np.abs(num[0]) > 1e-9 * np.max(np.abs(num[0])), num[0], 0.0)
    return TransferFunction(num=tuple(kept), den=tuple(den), delay_s=float(linear.delays_s[0]))


def _balance(M: FloatArray) -> FloatArray:
    """Return the scales (n,) in which each row of a matrix (n, n) is as large as its column, the diagonal left out."""
    scales, sizes = np.ones(len(M)), np.abs(M - np.diag(np.diag(M)))
    for i in np.tile(np.arange(len(M)), 10):
        row, column = np.sum(sizes[i] * scales) / scales[i], np.sum(sizes[:, i] / scales) * scales[i]
        scales[i] *= np.sqrt(row / column) if row > 0.0 and column > 0.0 else 1.0
    return scales


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
