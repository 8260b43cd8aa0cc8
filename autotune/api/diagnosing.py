"""Simulation and diagnosis: the one place where the public face calls them."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from autotune.api.plants import as_controller
from autotune.api.recordings import Source, read
from autotune.api.recordings import recordings as all_of
from autotune.arguments import number, settings_of
from autotune.errors import InputError
from autotune.models import Model


def simulate(model: Any, recording: Source, *, horizon_s: float | None = None) -> Any:
    """Return y simulated with a recording's u, shape (N,); with a horizon as forecasts of that length.

    Parameters
    ----------
    model : Model or its file
        The chain of blocks with its effects.
    recording : Recording, path, DataFrame, mapping of arrays
        u, and y for the state to begin with.
    horizon_s : float, optional
        Length of the windows [s] before which the state is estimated anew; one free run when absent.

    Examples
    --------
    >>> import autotune as at
    >>> oven = at.example("oven")
    >>> around = at.read({"t": oven.t, "u": oven.u - 5.0, "y": oven.y - 50.0})
    >>> y = at.simulate(at.Model.from_text("2 e^-0.5s/((2s+1)(3s+1))"), around)
    >>> bool((y - around.y).std() < 0.05)
    True
    """
    from autotune.diagnosis import forecast
    from autotune.equations.files import forecast_any
    from autotune.recorded_units import require_units_of_model

    if horizon_s is not None:
        horizon_s = number(horizon_s, name="horizon_s", where="simulate", above=0.0)
    given, record = _model(model), read(recording)
    require_units_of_model(given, [record])
    record.require_dense()
    if isinstance(given, Model):
        return np.asarray(forecast(given, record, horizon_s))
    return np.asarray(forecast_any(given, record, horizon_s))


def diagnose(model: Any, recordings: Source, controller: Any = None, **settings: Any) -> Any:
    """Return where and why recordings differ from a model's simulation.

    Parameters
    ----------
    model : Model or its file
        What the rig is believed to be.
    recordings : recording or list of recordings, paths, DataFrames
        Best with different excitation.
    controller : PI, controller file, optional
        The law that u was computed by.
    **settings
        Of :func:`autotune.diagnosis.diagnose`: ``without``, effects that are not looked for, and ``thresholds``.

    Returns
    -------
    Diagnosis
        ``verdict``, ``effects`` with their probabilities, ``places``, and the ``extended_model``.

    Examples
    --------
    >>> import autotune as at
    >>> oven = at.example("oven")
    >>> around = at.read({"t": oven.t, "u": oven.u - 5.0, "y": oven.y - 50.0})
    >>> believed = at.Model.from_text("1.5 e^-0.5s/((2s+1)(3s+1))")
    >>> diagnosis = at.diagnose(believed, around)
    >>> diagnosis.verdict
    'parameters'
    >>> round(diagnosis.extended_model.transfer_function().num[0], 1)
    2.0
    """
    import autotune.api.shown_diagnosis  # noqa: F401 - it registers the table
    from autotune.diagnosis import diagnose as search
    from autotune.recorded_units import require_units_of_each_other, require_units_of_model

    law = None if controller is None else as_controller(controller)
    given, records = _model(model), all_of(recordings)
    asked = settings_of(search, settings, where="diagnose", of=("without", "progress", "thresholds"))
    require_units_of_model(given, records)
    require_units_of_each_other(records)
    return search(given, records, law, **asked)


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
