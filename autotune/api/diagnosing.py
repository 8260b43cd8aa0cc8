"""The one place where the public face calls the diagnosis and the simulation."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from autotune.arrays import FloatArray
from autotune.controller import Controller
from autotune.models import Model
from autotune.recording import Recording


def diagnosed(model: Any, recordings: Sequence[Recording], controller: Controller | None, **settings: Any) -> Any:
    """Return the diagnosis of recordings."""
    from autotune.diagnosis import diagnose

    return diagnose(_model(model), recordings, controller, **settings)


def simulated(model: Any, recording: Recording, horizon_s: float | None) -> FloatArray:
    """Return y simulated with a recording's u, of a chain or of equations."""
    from autotune.diagnosis import forecast
    from autotune.equations import forecast as of_equations

    given = _model(model)
    run = forecast if isinstance(given, Model) else of_equations
    return run(given, recording, horizon_s)


def _model(model: Any) -> Any:
    from autotune.equations.files import read_any_model

    return read_any_model(model) if isinstance(model, str | os.PathLike) else model
