"""Model files of every kind behind one reader."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import tomli_w

from autotune.arrays import FloatArray
from autotune.effects import kind_of
from autotune.equations.black_box import BlackBox, run_closed
from autotune.equations.chain import chain_with_inputs
from autotune.equations.effects import equation_of
from autotune.equations.fmu import fmu_of
from autotune.equations.forecast import forecast
from autotune.equations.model import EquationModel
from autotune.equations.read import content_of, equations_of, write_equations
from autotune.errors import InputError
from autotune.model_tables import read_model, write_model
from autotune.models import Model
from autotune.recording import Recording
from autotune.text_files import read_toml
from autotune.whole_files import write_whole

AnyModel: TypeAlias = Model | EquationModel | BlackBox


def read_any_model(path: str | os.PathLike[str]) -> AnyModel:
    """Read a model file: a chain of blocks, with one input or several, equations, or an FMU.

    Raises
    ------
    InputError
        What is wrong, where, and how to fix it.
    """
    content = read_toml(path)
    if "block" in content and isinstance(content.get("input"), list):
        return chain_with_inputs(content, str(path))
    if "fmu" in content:
        return fmu_of(content, str(path))
    if "state" not in content:
        return read_model(path)
    return equations_of(content, str(path))


def write_any(model: AnyModel, path: Path, base: Path | None = None) -> None:
    """Write a model file that :func:`read_any_model` reads back, each effect with its equation.

    Parameters
    ----------
    model : Model, EquationModel or BlackBox
        What to write.
    path : path
        Where to.
    base : path, optional
        Folder that an FMU's path counted from so far.

    Raises
    ------
    InputError
        A Python function, which no file holds.
    """
    if isinstance(model, Model):
        write_model(model, path, {effect.name: kind_of(effect.name).equation for effect in model.effects})
        return
    inside = model if isinstance(model, EquationModel) else model.shell()
    equations = {effect.name: equation_of(inside, effect) for effect in model.effects}
    if isinstance(model, EquationModel):
        write_equations(model, path, equations)
        return
    if "fmu" not in (model.source or {}):
        raise InputError("a Python function is no file", where=model.name, remedy="write its equations, or an FMU")
    shell = content_of(replace(inside, parameters=model.parameters), equations)
    for table, variable in zip(shell["input"], model.source["variables"], strict=True):
        table["variable"] = variable
    fmu = ((base or Path()) / model.source["fmu"]).resolve()
    content = {"name": model.name, "fmu": str(fmu), "input": shell["input"], "output": {"value": model.source["value"]}}
    content["output"] |= {"unit": model.output_unit} if model.output_unit else {}
    content |= {key: shell[key] for key in ("parameters", "effect") if key in shell}
    write_whole(path, tomli_w.dumps(content))


def forecast_any(model: EquationModel | BlackBox, recording: Recording, horizon_s: float | None = None) -> FloatArray:
    """Simulate equations or a closed model with a recording's inputs, see :func:`autotune.equations.forecast.forecast`.

    Parameters
    ----------
    model : EquationModel or BlackBox
        The model.
    recording : Recording
        N rows; its columns drive the model.
    horizon_s : float, optional
        Length of the windows [s] before which the state is estimated anew; one free run when absent.

    Returns
    -------
    (N,) array
        y [y unit].

    Raises
    ------
    InputError
        As there; a horizon for a closed model, whose state cannot be set.
    """
    if isinstance(model, EquationModel):
        return forecast(model, recording, horizon_s)
    if horizon_s is not None:
        raise InputError("the state of a closed model cannot be set", where="--horizon", remedy="leave --horizon out")
    return run_closed(model, recording)
