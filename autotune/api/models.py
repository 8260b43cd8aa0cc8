"""``at.Model``: a model from wherever a person has one."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from autotune.arguments import check_arguments
from autotune.arrays import FloatArray
from autotune.equations.black_box import BlackBox
from autotune.equations.model import EquationModel
from autotune.models import Model as Chain


class Model:
    """Makers of models for ``simulate`` and ``diagnose``; none of what they return is an object of this class."""

    @staticmethod
    @check_arguments
    def read(path: str | os.PathLike[str]) -> Chain | EquationModel | BlackBox:
        """Return what a model file holds: a chain of blocks, equations, or an FMU with its inputs and parameters."""
        from autotune.model_file import read_any as read_any_model

        return read_any_model(path)

    @staticmethod
    @check_arguments
    def from_equations(content: Mapping[str, Any], name: str = "model") -> EquationModel:
        """Return equations from a mapping with the keys of a model file: ``input``, ``output``, ``state``, ..

        Parameters
        ----------
        content : mapping
            The tables of a model file.
        name : str
            Where ``content`` has none.
        """
        from autotune.equations.read import equations_of

        return equations_of({"name": name, **content}, str(content.get("name", name)))

    @staticmethod
    @check_arguments
    def from_control(system: Any, name: str = "") -> Chain | EquationModel:
        """Return a continuous system of python-control: a chain, or equations where it has several inputs.

        Parameters
        ----------
        system : control.TransferFunction or control.StateSpace
            Continuous; time in s.
        name : str
            Of the model.
        """
        from autotune.equations.imports import from_control

        return from_control(system, name)

    @staticmethod
    @check_arguments
    def from_text(text: str, name: str = "plant") -> Chain:
        """Return a transfer function as people write it: ``-65.5/(s(0.36s+1)) e^-0.1s``, zpk, gain and lags.

        Parameters
        ----------
        text : str
            In s [rad/s], dead time as ``e^-0.1s`` [s].
        name : str
            Of the model.
        """
        from autotune.equations.imports import from_coefficients
        from autotune.equations.transfer_text import parse_transfer_function

        tf = parse_transfer_function(text)
        return from_coefficients(tf.num, tf.den, tf.delay_s, name)

    @staticmethod
    @check_arguments
    def from_function(
        step: Callable[[Any, FloatArray, Mapping[str, float], float], tuple[Any, float]],
        state: Any,
        parameters: Mapping[str, float],
        *,
        columns: Sequence[str] = ("u",),
        name: str = "function",
    ) -> BlackBox:
        """Return a step function as a model: ``step(state, inputs, parameters, dt_s) -> (next_state, y)``.

        Parameters
        ----------
        step : callable
            From state, (columns,) inputs, parameters and time step [s] to the next state and y.
        state : object
            At the first row.
        parameters : mapping of str to float
            Names and nominal values of what may be fitted.
        columns : sequence of str
            The recording's columns that are the inputs, in order.
        name : str
            Of the model.
        """
        from autotune.equations.black_box import from_function

        return from_function(step, state, parameters, columns=columns, name=name)
