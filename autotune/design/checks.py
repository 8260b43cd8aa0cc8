"""The last look at a controller before it is called a result: its margins on everything that was measured.

A design keeps its margins on the plant it was made on. That plant may be a reduced model under conditions, a fit, or a
class of processes; here the same controller, of whatever kind, meets the fitted plant, the region of the fit, and the
measured points themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from autotune.controller import PIDController
from autotune.design.margins import Margins, margins
from autotune.design.on_fit import worst_of
from autotune.design.specification import Specification
from autotune.identification.parametric import PlantFit
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint

#: a margin counts as kept where it is short of what was asked by less than this share
TOLERANCE = 0.005
_SDS = 1.96


@dataclass(frozen=True, kw_only=True)
class Check:
    """The margins of a controller on one piece of evidence.

    Attributes
    ----------
    on : str
        The evidence, in words.
    kept : bool
        Whether the margins that were asked for are kept there.
    modulus : float
        Modulus margin there, of the worst plant; at the points the largest that the worst point's region allows.
    phase_rad : float
        Phase margin there [rad]; NaN at the points, which need not lie at the crossover.
    stable : bool
        Whether the loop is stable there; points alone cannot say, and do not deny it.
    """

    on: str
    kept: bool
    modulus: float
    phase_rad: float
    stable: bool = True

    @property
    def sentence(self) -> str:
        """What was found."""
        if not self.stable:
            return f"unstable on {self.on}"
        phase = "" if math.isnan(self.phase_rad) else f", {math.degrees(self.phase_rad):.1f} deg"
        return f"M_m {self.modulus:.3f}{phase} on {self.on}"

    def to_json(self) -> dict[str, Any]:
        """Return the form in ``result.json``."""
        phase = None if math.isnan(self.phase_rad) else math.degrees(self.phase_rad)
        return {"on": self.on, "kept": self.kept, "stable": self.stable, "modulus": self.modulus, "phase_deg": phase}


def on_plants(
    plants: Sequence[TransferFunction], controller: PIDController, specification: Specification, what: str
) -> Check:
    """Return the check on the worst of some plants.

    Parameters
    ----------
    plants : sequence of TransferFunction
        At least one.
    controller : PIDController
        What is checked.
    specification : Specification
        The margins that were asked for.
    what : str
        The plants in words.
    """
    found = [_margins_signed_by_stability(margins(plant, controller)) for plant in plants]
    asked = np.array([specification.modulus_margin, specification.phase_margin_rad])
    worst = min(found, key=lambda pair: float(np.min(np.array(pair[:2]) / asked)))
    modulus, phase, stable = worst
    kept = stable and bool(np.all(np.array([modulus, phase]) >= (1.0 - TOLERANCE) * asked))
    return Check(on=what, kept=kept, modulus=modulus, phase_rad=phase, stable=stable)


def _margins_signed_by_stability(m: Margins) -> tuple[float, float, bool]:
    return (m.modulus, m.phase_rad, True) if m.stable else (-m.modulus, -abs(m.phase_rad), False)


def on_points(points: Sequence[FrequencyPoint], controller: PIDController, specification: Specification) -> Check:
    """Return the check on the points: none of them lies inside the circle of the modulus margin with its whole region.

    A region that only touches the circle says nothing against the controller: what the points say together about the
    plant at their frequencies is narrower than each one's own region, and is what the fit's region stands for.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        At least one, with covariance.
    controller : PIDController
        What is checked.
    specification : Specification
        The margins that were asked for.
    """
    C = controller.response(np.array([point.omega_rad_s for point in points]))
    farthest = []
    for point, c in zip(points, C, strict=True):
        covariance = np.array(point.covariance)
        spread = _SDS * math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0)) * abs(c)
        farthest.append(abs(1.0 + c * point.response) + spread)
    modulus = float(min(farthest))
    kept = modulus >= (1.0 - TOLERANCE) * specification.modulus_margin
    return Check(on="the measured points", kept=kept, modulus=modulus, phase_rad=math.nan)


def checks(
    points: Sequence[FrequencyPoint],
    fit: PlantFit,
    controller: PIDController,
    specification: Specification,
    *,
    region: bool,
) -> tuple[Check, ...]:
    """Return the checks of a controller on the fitted plant, the points, and the region of the fit, in this order.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        What was measured; may be empty.
    fit : PlantFit
        Fitted plant with its region.
    controller : PIDController
        Of any kind, from any source.
    specification : Specification
        What was asked for.
    region : bool
        Whether the fit's region counts; it does not for a design on the points, which bounds a wider class.
    """
    found = [on_plants((fit.plant,), controller, specification, "the fitted plant")]
    if points:
        found.append(on_points(points, controller, specification))
    if not region:
        return tuple(found)
    distance = specification.distance
    border = worst_of(fit.border(distance), controller, specification)
    found.append(
        on_plants(border, controller, specification, f"plants {distance:.2f} standard deviations from the fitted one")
    )
    return tuple(found)
