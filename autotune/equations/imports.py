"""Models from elsewhere: python-control systems, coefficients as MATLAB prints them, Python functions of equations."""

from __future__ import annotations

import ast
import runpy
from pathlib import Path
from typing import Any

import numpy as np

from autotune.equations.chain import sum_of
from autotune.equations.expressions import Call, Expression, Name
from autotune.equations.model import EquationModel, InputColumn, ModelParameter, State
from autotune.errors import InputError
from autotune.models import Block, Model, Port, TransferFunction


def from_coefficients(num: Any, den: Any, delay_s: float = 0.0, name: str = "plant") -> Model:
    """Return a chain of one block from coefficients in descending powers of s.

    Parameters
    ----------
    num, den : sequence of float
        Descending powers of s [rad/s].
    delay_s : float
        Dead time [s].
    name : str
        Of the model.

    Raises
    ------
    InputError
        Not proper, or no finite numbers.
    """
    dynamics = TransferFunction(
        num=tuple(float(v) for v in np.atleast_1d(num)), den=tuple(float(v) for v in np.atleast_1d(den)),
        delay_s=delay_s,
    )  # fmt: skip
    if not dynamics.is_proper:
        raise InputError("num has a higher degree than den", where=name, remedy="a model must be proper")
    return Model(name=name, input=Port(), output=Port(), blocks=(Block(name=name, place="plant", dynamics=dynamics),))


def from_matlab(num: str, den: str, delay_s: float = 0.0, name: str = "plant") -> Model:
    """Return a chain of one block from vectors as MATLAB prints them: ``"[1 2]"``, ``"1, 3.5, 0"``.

    Parameters
    ----------
    num, den : str
        Descending powers of s [rad/s].
    delay_s : float
        Dead time [s].
    name : str
        Of the model.

    Raises
    ------
    InputError
        A text that is no vector of numbers.
    """
    return from_coefficients(_vector(num), _vector(den), delay_s, name)


def _vector(text: str) -> list[float]:
    parts = text.strip().strip("[]").replace(",", " ").replace(";", " ").split()
    try:
        values = [float(ast.literal_eval(part)) for part in parts]
    except (ValueError, SyntaxError, TypeError):
        raise InputError(f"{text!r} is no vector of numbers", where="from-matlab", remedy='write "[1 2 0]"') from None
    if not values:
        raise InputError("an empty vector", where="from-matlab", remedy='write "[1 2 0]"')
    return values


def from_control(system: Any, name: str = "") -> Model | EquationModel:
    """Return a python-control system as a model.

    Parameters
    ----------
    system : control.TransferFunction or control.StateSpace
        In continuous time; with one input and one output it becomes a chain, with several inputs equations.
    name : str
        What it is; the system's own name by default.

    Returns
    -------
    Model or EquationModel
        The same system: in equations a state per state, named as the system names it where it does.

    Raises
    ------
    InputError
        A system in discrete time, with several outputs, or of another kind.
    """
    name = name or str(getattr(system, "name", "") or "plant")
    kind = type(system).__name__
    if kind not in ("TransferFunction", "StateSpace") or not hasattr(system, "dt"):
        raise InputError(
            f"a {kind} is no linear system", where=name,
            remedy="give a TransferFunction or a StateSpace, or write the equations as a model file",
        )  # fmt: skip
    if system.dt not in (None, 0):
        raise InputError(f"the system is in discrete time (dt = {system.dt})", where=name,
                         remedy="give the system in continuous time")  # fmt: skip
    if system.noutputs != 1:
        raise InputError(f"{system.noutputs} outputs", where=name, remedy="choose one: system[0, :]")
    if system.ninputs == 1:
        import control

        tf = control.tf(system)
        return from_coefficients(tf.num[0][0], tf.den[0][0], name=name)
    import control

    return _from_state_space(control.ss(system), name)


def _from_state_space(system: Any, name: str) -> EquationModel:
    """Return a state space with several inputs as equations; entries that are neither 0 nor 1 become parameters."""
    labels = [label if label.isidentifier() else f"x{i + 1}" for i, label in enumerate(system.state_labels)]
    columns = [label if label.isidentifier() else f"u{i + 1}" for i, label in enumerate(system.input_labels)]
    columns = ["u" if c in ("u[0]", "u0", "u1") and i == 0 else c for i, c in enumerate(columns)]
    parameters: list[ModelParameter] = []

    def row(letter: str, i: int, values: Any, names: list[str]) -> list[Expression]:
        parts: list[Expression] = []
        for j, value in enumerate(np.asarray(values, dtype=np.float64).ravel()):
            if value == 0.0:
                continue
            if value == 1.0:
                parts.append(Name(names[j]))
                continue
            parameters.append(ModelParameter(name=f"{letter}_{i + 1}_{j + 1}", value=float(value)))
            parts.append(Call("*", (Name(parameters[-1].name), Name(names[j]))))
        return parts

    states = tuple(
        State(name=label, derivative=sum_of(row("A", i, system.A[i], labels) + row("B", i, system.B[i], columns)))
        for i, label in enumerate(labels)
    )
    output = sum_of(row("C", 0, system.C[0], labels) + row("D", 0, system.D[0], columns))
    return EquationModel(
        name=name, inputs=tuple(InputColumn(column=c) for c in columns), output=output, states=states,
        parameters=tuple(parameters),
    )  # fmt: skip


def from_python_file(place: str) -> Model | EquationModel:
    """Return the python-control system that a variable of a Python file holds; the file is executed.

    Parameters
    ----------
    place : str
        ``FILE.py:name``.

    Raises
    ------
    InputError
        No such file or variable, or a file that fails.
    """
    file, _, variable = place.rpartition(":")
    if not file or not variable.isidentifier():
        raise InputError(f"{place!r}", where="from-control", remedy="write FILE.py:name of the system in it")
    if not Path(file).is_file():
        raise InputError("no such file", where=file, remedy="check the path")
    try:
        names = runpy.run_path(file)
    except Exception as error:  # the file is a person's own program
        raise InputError(
            f"fails with {type(error).__name__}: {error}", where=file, remedy="run it with python"
        ) from None
    if variable not in names:
        raise InputError(f"has no {variable!r}", where=file, remedy="name the system's variable")
    return from_control(names[variable], name=variable)
