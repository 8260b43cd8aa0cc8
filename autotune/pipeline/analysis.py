"""From frequency points to a checked controller, without a rig: fit, reduce, design, validate."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from autotune.config.procedure import DesignSettings
from autotune.controller import PIDController
from autotune.design.margins import Margins, margins
from autotune.design.nugap import Validation, loop_scaling, validate
from autotune.design.robust import design_on_points
from autotune.design.specification import Design, Specification
from autotune.design.synthesis import design
from autotune.errors import AutotuneError
from autotune.identification.parametric import PlantFit, fit_plant
from autotune.identification.reduction import ReducedModel, reduce_points
from autotune.points import FrequencyPoint

#: Below this phase [deg] a PI has no use for a point, and another turn could not be told from a rise.
LOWEST_PHASE_DEG = -270.0


@dataclass(frozen=True, kw_only=True)
class Analysis:
    """What follows from the points alone, without a rig.

    Attributes
    ----------
    points : tuple of FrequencyPoint
        What was measured.
    fit : PlantFit
        Transfer function through the points, for predictions.
    reduced : ReducedModel
        Model whose margins are a guarantee.
    design : Design
        Controller, by default on the reduced model.
    alternatives : tuple of (str, Design or str)
        What other bases of the design give: the reduced model, the points, the fitted plant held for true; or why not.
    margins : Margins
        Of the controller on the fitted plant.
    unscaled, scaled : Validation
        Criterion (10) in the units of the signals, and scaled as the loop itself weighs them at its crossover.
    warnings : tuple of str
        What the reader should know.
    """

    points: tuple[FrequencyPoint, ...]
    fit: PlantFit
    reduced: ReducedModel
    design: Design
    alternatives: tuple[tuple[str, Design | str], ...]
    margins: Margins
    unscaled: Validation
    scaled: Validation
    warnings: tuple[str, ...]

    @property
    def controller(self) -> PIDController:
        """The controller."""
        return self.design.controller


def specification(settings: DesignSettings) -> Specification:
    """Return the constraints that the configuration asks for."""
    modulus, phase_rad = settings.margins
    return Specification(modulus_margin=modulus, phase_margin_rad=phase_rad, noise_gain=settings.noise_gain)


def analyse(points: Sequence[FrequencyPoint], settings: DesignSettings, *, compare: bool = True) -> Analysis:
    """Fit, reduce, design and validate.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        At least three, spanning -135 degrees; those past -270 degrees are left out, with a warning.
    settings : DesignSettings
        Structure, specification, and whether to design on the reduced model or straight on the points.
    compare : bool
        Whether to design on the other bases too; the design on the points takes more than all the rest.

    Raises
    ------
    IdentificationError, DesignError
        The points do not determine a model, or no controller meets the specification.
    """
    measured = sorted(points, key=lambda point: point.omega_rad_s)
    points = of_use(measured)
    left_out = len(measured) - len(points)
    beyond = (f"{left_out} points past {LOWEST_PHASE_DEG:g} deg were left out: a PI has no use for them",)
    fit = fit_plant(points)
    reduced = reduce_points(points)
    H_r = reduced.transfer_function()
    wanted, kind = specification(settings), settings.kind
    bases: dict[str, Callable[[], Design]] = {
        "reduced model": lambda: design(H_r, wanted, kind),
        "points": lambda: design_on_points(points, wanted, kind),
        "fitted plant": lambda: design(fit.plant, wanted, kind, certificate=False),
    }
    designed = bases.pop(settings.source)()
    controller = designed.controller
    achieved = margins(fit.plant, controller)
    return Analysis(
        points=tuple(measured),
        fit=fit,
        reduced=reduced,
        design=designed,
        alternatives=tuple((name, _or_reason(make)) for name, make in bases.items()) if compare else (),
        margins=achieved,
        unscaled=validate(fit.plant, H_r, controller),
        scaled=validate(fit.plant, H_r, controller, scaling=loop_scaling(H_r, controller)),
        warnings=(*(beyond if left_out else ()), *reduced.warnings),
    )


def of_use(points: Sequence[FrequencyPoint]) -> list[FrequencyPoint]:
    """Return the points up to the frequency where the plant's phase, unwrapped from the lowest, is below -270 deg."""
    ordered = sorted(points, key=lambda point: point.omega_rad_s)
    phase = np.degrees(np.unwrap([point.phase_rad for point in ordered]))
    of_positive_gain = phase - 180.0 * math.ceil((phase[0] - 30.0) / 180.0)
    beyond = np.flatnonzero(of_positive_gain < LOWEST_PHASE_DEG)
    return ordered[: int(beyond[0])] if beyond.size else ordered


def _or_reason(make: Callable[[], Design]) -> Design | str:
    """Return a design for comparison, or why there is none; only the one asked for may stop a run."""
    try:
        return make()
    except AutotuneError as error:
        return str(error)
