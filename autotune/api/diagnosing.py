"""The one place where the public face calls the diagnosis and the simulation."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from autotune.arguments import settings_of
from autotune.arrays import FloatArray
from autotune.controller import Controller
from autotune.errors import InputError
from autotune.models import Model
from autotune.recording import Recording


def diagnosed(model: Any, recordings: Sequence[Recording], controller: Controller | None, **settings: Any) -> Any:
    """Return the diagnosis of recordings, which shows itself as a table.

    Parameters
    ----------
    model : object
        A model, or what :func:`autotune.diagnose` takes for one.
    recordings : sequence of Recording
        With the model's u and y.
    controller : Controller or None
        The law that closed the loop, if one did.
    **settings : object
        Keyword arguments of :func:`autotune.diagnosis.diagnose`.

    Raises
    ------
    InputError
        A setting that is not known, or units that do not fit the model or each other.
    """
    import autotune.api.shown_diagnosis  # noqa: F401 - it registers the table
    from autotune.diagnosis import diagnose
    from autotune.equations.recorded_units import require_units_of_each_other, require_units_of_model

    given = _model(model)
    asked = settings_of(diagnose, settings, where="diagnose", of=("without", "progress", "thresholds"))
    require_units_of_model(given, recordings)
    require_units_of_each_other(recordings)
    return diagnose(given, recordings, controller, **asked)


def simulated(model: Any, recording: Recording, horizon_s: float | None) -> FloatArray:
    """Return y simulated with a recording's u, of a chain, of equations or of an FMU.

    Parameters
    ----------
    model : object
        A model, or what :func:`autotune.simulate` takes for one.
    recording : Recording
        N rows, evenly sampled; its u drives the model.
    horizon_s : float or None
        Length of the windows [s] before which the state is estimated anew; None for one free run.

    Returns
    -------
    (N,) array
        y [y unit].

    Raises
    ------
    InputError
        Units that do not fit, or a recording with gaps.
    """
    from autotune.diagnosis import forecast
    from autotune.equations.files import forecast_any
    from autotune.equations.recorded_units import require_units_of_model

    given = _model(model)
    require_units_of_model(given, [recording])
    recording.require_dense()
    if isinstance(given, Model):
        return forecast(given, recording, horizon_s)
    return forecast_any(given, recording, horizon_s)


def _model(model: Any) -> Any:
    from autotune.equations.black_box import BlackBox
    from autotune.equations.model import EquationModel
    from autotune.model_file import read_any as read_any_model

    if isinstance(model, str | os.PathLike):
        return read_any_model(model)
    if not isinstance(model, Model | EquationModel | BlackBox):
        raise InputError(
            f"a {type(model).__name__} is no model",
            where="model",
            remedy="give a model file or what autotune.Model makes, such as Model.from_text",
        )
    return model
