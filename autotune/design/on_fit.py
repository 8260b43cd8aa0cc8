"""Synthesis on a fitted plant and its region: margins for every plant on the border of what the data leave possible.

The parameters of a fit are known to so many standard deviations, and other structures may not be excluded by the data.
The controller minimises the norm on the estimate while the plants as far off as the margins need keep them too (see
:attr:`autotune.design.specification.Specification.distance`). That border is visited in many directions, but only the
few plants that bind become constraints (a cutting-plane method: what is violated is added until nothing is).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.members import Members, members_of
from autotune.design.specification import PROBABILITY, Design, Kind, Specification
from autotune.design.synthesis import design
from autotune.errors import DesignError
from autotune.identification.parametric import PlantFit
from autotune.models import TransferFunction

ROUNDS = 8
#: probability below which the points contradict a fit's structure
CONTRADICTED = 1e-3
#: a plant of the region that misses a constraint by less is not worth another round; the answer says what is kept
TOLERANCE = 2e-3


def design_on_fit(fit: PlantFit, specification: Specification, kind: Kind = "pi") -> Design:
    """Return the controller with the smallest norm on the estimate that keeps the constraints on the whole region.

    Parameters
    ----------
    fit : PlantFit
        Estimate, region, and the structures that the data do not exclude.
    specification : Specification
        Constraints (18).
    kind : {"pi", "pid"}
        Structure of the controller.

    Returns
    -------
    Design
        Its margins are those of the worst plant of the region; its norm is the estimate's.

    Raises
    ------
    DesignError
        Nothing of this structure keeps the constraints on the region; names the nearest specification.

    Notes
    -----
    The guarantee is that of the structures: a plant that none of them can follow is not covered, which
    :func:`autotune.design.robust.design_on_points` is for.
    """
    if fit.source == "points" and fit.p_value < CONTRADICTED:
        raise DesignError(
            f"no plant of lags, integrator and dead time follows the points (chi-square {fit.chi_square:.0f} with "
            f"{fit.degrees_of_freedom} degrees of freedom)",
            where="fitted plant",
            remedy="record the plant under steps of the command, which shows resonances, or design on a model of it",
        )
    border = members_of(fit.border(specification.distance), specification)
    found, slack = design_on_plants(fit.plant, border, specification, kind)
    if np.min(slack) < -2.0 * TOLERANCE:
        raise DesignError(
            "no controller was found that keeps the margins on the whole region of the fitted plant",
            where="synthesis",
            remedy="record longer, or with larger steps of the command",
        )
    return replace(
        found,
        certificate=f"margins hold for the plants within {specification.distance:.2f} standard deviations of the "
        f"fitted one: the rig keeps all of them with {100 * PROBABILITY:g} %; no lower bound on the norm",
    )


def design_on_plants(
    nominal: TransferFunction, members: Members, specification: Specification, kind: Kind
) -> tuple[Design, FloatArray]:
    """Return the controller of least norm on ``nominal`` that all members keep, and their (S, 3) slacks.

    Members that miss a constraint become constraints of the next round, until none does.

    Parameters
    ----------
    nominal : TransferFunction
        The plant whose norm is made small.
    members : Members
        S plants that the controller keeps the margins on.
    specification : Specification
        Constraints (18).
    kind : {"pi", "pid"}
        Structure of the controller.

    Raises
    ------
    DesignError
        Nothing of this structure keeps the constraints on the members that were violated so far.
    """
    chosen: list[int] = []
    for _ in range(ROUNDS):
        found = design(nominal, specification, kind, also=members.chosen(chosen).plants, certificate=False)
        slack = members.slacks(found.controller, specification)
        worst = most_missed(slack)
        if worst <= set(chosen):
            break
        chosen += sorted(worst - set(chosen))
    return found, slack


def most_missed(slack: FloatArray) -> set[int]:
    """Return which plants miss a margin most, given their (S, 3) slacks: what a next round must keep as well."""
    return {int(i) for i in np.argmin(slack, axis=0) if np.min(slack[i]) < -TOLERANCE}


def worst_of(
    members: Sequence[TransferFunction], controller: PIDController, specification: Specification
) -> tuple[TransferFunction, ...]:
    """Return the members on which one margin or another is smallest with the controller, three at most.

    Parameters
    ----------
    members : sequence of TransferFunction
        Plants.
    controller : PIDController
        The one they are held against.
    specification : Specification
        Says which margins count.
    """
    slack = members_of(members, specification).slacks(controller, specification)
    return tuple(members[i] for i in sorted({int(i) for i in np.argmin(slack, axis=0)}))
