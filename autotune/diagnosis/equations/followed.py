"""What states and ports of equations do under a fit: the signals that effects' sizes are taken from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.effects import compile_with, position_under
from autotune.equations.expressions import Expression, Name, Number, to_text
from autotune.equations.fit_data import Fitted
from autotune.equations.model import EquationModel, Extension
from autotune.equations.sensitivity import Windows, run_windows
from autotune.equations.shared_forces import Joint, joint_at
from autotune.equations.simulate import Compiled, Drive, compile_model, derivatives
from autotune.models import Effect


def followed(
    model: EquationModel, effects: Sequence[Effect], fitted: Fitted, drives: Sequence[Drive],
    states: Callable[[Compiled, Windows, int], FloatArray],
) -> tuple[FloatArray, dict[str, FloatArray]]:  # fmt: skip
    """Return the simulated reading, and states and differences across ports by name, where a simulation goes on.

    Parameters
    ----------
    model, effects, fitted, drives
        A fit with effects, and what drives each recording.
    states : callable of compiled, windows and the recording's number
        Start states of the windows, in the compiled model's order.
    """
    positions = {one.name: _position_text(model, one.across) for one in model.ports}
    wanted = {name: name for name in model.state_names}
    wanted |= {one.name: to_text(one.across) for one in model.ports if one.across is not None}
    wanted |= {f"{name}:position": text for name, text in positions.items() if text}
    for name, joint in _apart(model).items():
        wanted |= {f"{name}:speed": to_text(joint.speed), f"{name}:position": to_text(joint.position)}
    compiled = compile_with(model, effects, list(wanted.values()))
    runs: list[FloatArray] = []
    for drive, w in zip(drives, fitted.windows, strict=True):
        begun = replace(w, states=states(compiled, w, len(runs)))
        runs.append(run_windows(compiled, fitted.parameters, drive, begun).outputs)
    columns = np.concatenate(runs)
    columns = columns[np.all(np.isfinite(columns), axis=1)]
    return columns[:, 0], {name: columns[:, 1 + i] for i, name in enumerate(wanted)}


def positions_of(model: EquationModel) -> dict[str, str]:
    """Return the name of the position that goes with each state and port."""
    apart = [*(one.name for one in model.ports), *_apart(model)]
    return {s.name: s.of or s.name for s in model.states} | {name: f"{name}:position" for name in apart}


def speeds_of(model: EquationModel) -> dict[str, str]:
    """Return the name of the speed that a force at each state and port goes with."""
    names = [*model.state_names, *(one.name for one in model.ports)]
    return {name: name for name in names} | {name: f"{name}:speed" for name in _apart(model)}


def _apart(model: EquationModel) -> dict[str, Joint]:
    """Return the states at which a force goes with another speed than the state's own."""
    joints = {name: joint_at(model, name) for name in model.state_names}
    return {name: joint for name, joint in joints.items() if joint.speed != Name(name)}


def sizes_of(
    model: EquationModel, parameters: FloatArray, values: Mapping[str, FloatArray], inputs: FloatArray, dt_s: float
) -> dict[str, float]:
    """Return how large each state's derivative is, and the force at each port that would make the largest so large."""
    sizes = {n: float(np.std(np.diff(values[n]) / dt_s)) + 1e-300 for n in model.state_names}
    for port in model.ports:
        sizes[port.name] = _force_size(model, parameters, port.name, sizes, inputs)
    return sizes


def _force_size(
    model: EquationModel, parameters: FloatArray, port: str, sizes: Mapping[str, float], inputs: FloatArray
) -> float:
    x = np.zeros((1, len(model.states)))
    p = parameters[: len(model.parameters)]
    none = derivatives(compile_model(model), p, x, inputs)[0]
    one = Extension(name="unit", port={port: Number(1.0)})
    change = np.abs(derivatives(compile_model(model, [one]), p, x, inputs)[0] - none)[0]
    ratios = [sizes[n] / c for n, c in zip(model.state_names, change, strict=True) if c > 0.0]
    return max(ratios, default=1.0)


def _position_text(model: EquationModel, across: Expression | None) -> str:
    tree = None if across is None else position_under(model, across)
    return "" if tree is None else to_text(tree)
