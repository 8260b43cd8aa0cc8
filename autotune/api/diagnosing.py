"""The one place where the public face calls the diagnosis."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from autotune.arrays import FloatArray
from autotune.controller import Controller
from autotune.models import read_model
from autotune.recording import Recording


def diagnosed(model: Any, recordings: Sequence[Recording], controller: Controller | None, **settings: Any) -> Any:
    """Return the diagnosis of recordings."""
    from autotune.diagnosis.diagnose import diagnose

    return diagnose(_model(model), recordings, controller, **settings)


def simulated(model: Any, recording: Recording, horizon_s: float | None) -> FloatArray:
    """Return y simulated with a recording's u."""
    from autotune.diagnosis.forecast import forecast

    return forecast(_model(model), recording, horizon_s)


def _model(model: Any) -> Any:
    return read_model(model) if isinstance(model, str | os.PathLike) else model
