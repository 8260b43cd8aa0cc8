"""The paper's way for a plant that is known: a PI on its reduced model, whose margins the plant itself keeps too.

Proposition 1 of Le & Mendes takes the margins from H_r to H under conditions (5) and (6). With (5) alone, arg L_r may
rise where a PI's integral action ends (T_I > 2/omega_d); the plant, whose gain is lower, then crosses over at a lower
frequency, where the phase of L_r is lower than at its own crossover, and some hundredths of a degree are lost. What is
enough without (6): let r(omega) = abs(H/H_r) <= 1. Up to the frequency omega_x where arg L_r = -180 degrees,

    abs(1 + L) >= abs(1 + r L_r) >= min over g in [r, 1] of abs(1 + g L_r),

as L = r exp(j theta) L_r with theta >= 0 by C2 and arg L <= 0, and turning a point whose argument is in [-180, 0]
degrees towards 0 moves it away from -1. Beyond omega_x, abs(L) <= abs(L_r(omega_x)) < 1 by C1 and (4), so that
abs(1 + L) >= 1 - abs(L_r(omega_x)) = abs(1 + L_r(omega_x)). Likewise where abs(L) = 1, arg L >= arg L_r = arg g L_r
with g = r. Hence the margins hold on H where they hold for g H_r with g = r(omega) to 1 at each frequency, and C2 is
needed up to omega_x, which lies at or before the -180 degrees of H. (6) is one way to see that g below 1 does no harm.
Where H is known nothing has to be inferred: its own margins are required beside those of H_r, which costs nothing where
the proposition applies.
"""

from __future__ import annotations

from dataclasses import replace

from autotune.design.loop import Plant, transfer_function_of
from autotune.design.margins import margins
from autotune.design.specification import Design, Kind, Specification
from autotune.design.synthesis import design
from autotune.errors import DesignError
from autotune.identification.reduction import ReducedModel, reduce_transfer_function


def design_on_reduced(
    plant: Plant,
    specification: Specification,
    kind: Kind = "pi",
    *,
    reduced: ReducedModel | None = None,
    certificate: bool = False,
) -> Design:
    """Return the PI of least norm on the reduced model of a plant, its margins kept on the plant too.

    Parameters
    ----------
    plant : TransferFunction or Model
        H of class (1), or the fitted plant where ``reduced`` is a reduced model of points.
    specification : Specification
        Constraints (18).
    kind : {"pi", "pid"}
        ``pid`` is refused.
    reduced : ReducedModel, optional
        H_r; the plant's own by (9) where absent.
    certificate : bool
        Whether to prove a lower bound on the norm on H_r.

    Returns
    -------
    Design
        Margins and norm are those on H_r; those on the plant are not smaller than what was asked for.

    Raises
    ------
    DesignError
        A PID was asked for, whose phase rises above 0 (outside class (2)), or nothing keeps the margins.
    IdentificationError
        The plant is outside class (1), or its dead time is too long for conditions (5).

    References
    ----------
    Le & Mendes 2010, (1), (2), (5), (6), Proposition 1.
    """
    if kind != "pi":
        raise DesignError(
            "a PID is not of class (2), so that margins on the reduced model are no guarantee",
            where="reduced model",
            remedy="design it on the points, on the fitted plant or on a model",
        )
    H = transfer_function_of(plant)
    H_r = (reduce_transfer_function(H) if reduced is None else reduced).transfer_function()
    found = design(H_r, specification, "pi", also=(H,), certificate=certificate)
    m = margins(H_r, found.controller, noise_frequency_rad_s=specification.noise_frequency_rad_s)
    return replace(found, margins=m)
