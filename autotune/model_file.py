"""Model files as commands read them: effects that no catalogue has are refused where the file is read."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from autotune.model_tables import read_model as read_chain
from autotune.models import Model

if TYPE_CHECKING:
    from autotune.equations.files import AnyModel


def read_model(path: str | os.PathLike[str]) -> Model:
    """Read a chain of blocks whose effects are all known.

    Raises
    ------
    InputError
        As :func:`autotune.model_tables.read_model`; an unknown effect, with the list of known ones.
    """
    model = read_chain(path)
    if model.effects:
        # the catalogue is loaded where it is asked: a chain alone is read at once
        from autotune.effects import require_known

        require_known(model.effects, str(path))
    return model


def read_any(path: str | os.PathLike[str]) -> AnyModel:
    """Read a model file of any kind whose effects are all known.

    Raises
    ------
    InputError
        As :func:`autotune.equations.files.read_any_model`; an unknown effect, with the list of known ones.
    """
    from autotune.effects import require_known
    from autotune.equations.files import read_any_model

    model = read_any_model(path)
    require_known(model.effects, str(path), in_chain=isinstance(model, Model))
    return model
