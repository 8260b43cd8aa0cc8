"""Model files of every kind behind one reader."""

from __future__ import annotations

import os
from typing import TypeAlias

from autotune.equations.chain import chain_with_inputs
from autotune.equations.model import EquationModel
from autotune.equations.read import equations_of
from autotune.models import Model, read_model
from autotune.text_files import read_toml

AnyModel: TypeAlias = Model | EquationModel


def read_any_model(path: str | os.PathLike[str]) -> AnyModel:
    """Read a model file: a chain of blocks, with one input or several, or equations.

    Raises
    ------
    InputError
        What is wrong, where, and how to fix it.
    """
    content = read_toml(path)
    if "block" in content and isinstance(content.get("input"), list):
        return chain_with_inputs(content, str(path))
    if "state" not in content:
        return read_model(path)
    return equations_of(content, str(path))
