"""Plants and controllers from what a person has."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from autotune.api.python_control import from_control
from autotune.controller import Controller, DiscreteController, PIDController, read_controller
from autotune.design.rst import RST
from autotune.errors import InputError
from autotune.model_tables import read_model
from autotune.models import LARGEST, SMALLEST, Model, TransferFunction

if TYPE_CHECKING:
    from autotune.identification.parametric import PlantFit
    from autotune.identification.reduction import ReducedModel


def as_plant(source: Any) -> TransferFunction:
    """Return the transfer function of a model, a reduced model, a delay model, a file, or a python-control system.

    Raises
    ------
    InputError
        Nothing of these, or a system in discrete time.
    """
    if isinstance(source, TransferFunction):
        return _require_proper(source)
    if isinstance(source, str | os.PathLike):
        return _require_proper(read_model(source).transfer_function())
    if isinstance(source, Model) or hasattr(source, "transfer_function"):
        return _require_proper(source.transfer_function())
    if hasattr(source, "dt"):  # python-control's mark of a system
        return _require_proper(from_control(source))
    raise InputError(
        f"a {type(source).__name__} is no plant",
        where="plant",
        remedy="give a TransferFunction, a model or its file, a reduced or delay model, or a python-control system",
    )


def _require_proper(plant: Any) -> TransferFunction:
    if not isinstance(plant, TransferFunction):
        raise InputError("a system in discrete time", where="plant", remedy="give the plant in continuous time")
    if not plant.is_proper:
        raise InputError(
            f"a numerator of degree {len(plant.num) - 1} over a denominator of degree {len(plant.den) - 1}",
            where="plant",
            remedy="no plant differentiates: add the lag that is missing",
        )
    sizes = [abs(value) for value in (*plant.num, *plant.den, plant.delay_s) if value != 0.0]
    if sizes and not (min(sizes) >= SMALLEST and max(sizes) <= LARGEST):
        raise InputError(
            f"numbers from {min(sizes):.3g} to {max(sizes):.3g}",
            where="plant",
            remedy=f"write it in other units: coefficients lie between {SMALLEST:g} and {LARGEST:g}",
        )
    return plant


def as_reduced(source: Any) -> ReducedModel | None:
    """Return the reduced model that something is, or that its file holds; None for everything else."""
    from autotune.identification.reduced_file import read_reduced
    from autotune.identification.reduction import ReducedModel

    if isinstance(source, ReducedModel):
        return source
    return read_reduced(source) if isinstance(source, str | os.PathLike) else None


def as_loop_plant(source: Any) -> PlantFit | None:
    """Return the plant of a loop's identification, or of its file, with its region; None for everything else."""
    if isinstance(source, str | os.PathLike):
        from autotune.identification.closed_loop.loop_plant import read_loop_region

        region = read_loop_region(source) if os.path.splitext(source)[1].lower() == ".json" else None
        return None if region is None else region.plant_fit()
    from autotune.identification.closed_loop.identify import ClosedLoopIdentification

    if not isinstance(source, ClosedLoopIdentification):
        return None
    from autotune.identification.closed_loop.loop_plant import loop_plant

    return loop_plant(source.structures)


def as_controller(source: Any) -> Controller:
    """Return the controller in a design, a file, or a python-control system; of an RST its feedback R/S."""
    if isinstance(source, PIDController | TransferFunction | DiscreteController):
        return source
    if isinstance(source, RST):
        return source.feedback()
    if isinstance(source, str | os.PathLike):
        return read_controller(source)
    if hasattr(source, "controller"):
        return as_controller(source.controller)
    if hasattr(source, "dt"):
        made = from_control(source)
        if isinstance(made, TransferFunction | DiscreteController):
            return made
    raise InputError(
        f"a {type(source).__name__} is no controller",
        where="controller",
        remedy="give PI(K=, Ti_s=), a design, a controller file, or a python-control system",
    )
