"""Model files of every kind behind one reader."""

from __future__ import annotations

import os
from typing import TypeAlias

from autotune.equations.model import EquationModel
from autotune.equations.read import equations_of, table_of
from autotune.models import Model, read_model

AnyModel: TypeAlias = Model | EquationModel


def read_any_model(path: str | os.PathLike[str]) -> AnyModel:
    """Read a model file: a chain of blocks, or equations.

    Raises
    ------
    InputError
        What is wrong, where, and how to fix it.
    """
    content = table_of(path)
    if "block" in content or not {"state", "fmu"} & set(content):
        return read_model(path)
    return equations_of(content, str(path))
