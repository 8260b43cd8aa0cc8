"""Synthesis on plants of low order through measured points, where no aperiodic process passes through them.

A resonance, a lead or an unstable pole makes points that the class of :mod:`autotune.design.process_class` contradicts.
Then the margins are required of every sampled plant of low order that the points leave possible, in all structures.
Where these plants do not agree on a controller, the answer is the frequency at which they disagree most.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.kernels import SampledPlant
from autotune.design.margins import Margins
from autotune.design.members import Members, crossovers, members_of
from autotune.design.on_fit import TOLERANCE, design_on_plants
from autotune.design.specification import Design, Kind, Specification
from autotune.errors import DesignError
from autotune.identification.consistent_structures import ConsistentStructures

#: how far beyond the points a frequency is looked for at which the plants disagree
_REACH = 4.0


def design_on_structures(structures: ConsistentStructures, specification: Specification, kind: Kind = "pi") -> Design:
    """Return the controller of least norm on the closest plant that all plants of low order through the points keep.

    Parameters
    ----------
    structures : ConsistentStructures
        Plants through the points, at least one.
    specification : Specification
        Constraints (18).
    kind : {"pi", "pid"}
        Structure of the controller.

    Returns
    -------
    Design
        Its margins are those that every one of the plants has at least; its norm and crossover are the closest one's.

    Raises
    ------
    DesignError
        The plants do not agree on a controller; names the frequency to measure.

    Notes
    -----
    The guarantee is that of the structures, sampled: see :mod:`autotune.identification.consistent_structures`. Of phase
    and delay margin at a crossover below the points no more is said than the modulus margin leaves of them. Beyond the
    points the certificate says from which frequency on no plant's phase is relied on.
    """
    assert structures.nominal is not None
    members = members_of(structures.plants, specification)
    try:
        found, slack = design_on_plants(structures.nominal, members, specification, kind)
    except DesignError as error:
        raise DesignError(
            f"no {kind.upper()} was found that all plants through the points keep ({error.what})",
            where="points",
            remedy=f"{error.remedy}; or {where_to_measure(structures)}",
        ) from None
    require_kept(slack, structures, specification)
    least, remark = _as_seen(members.least(found.margins, found.controller), members, found.controller, structures)
    return replace(
        found,
        margins=least,
        certificate=(
            "margins hold for every sampled plant of low order (lags, a resonance, a lead or a zero in the right half "
            "plane, one unstable pole, dead time) through the joint region of the points, none of which is an "
            f"aperiodic process; no lower bound on the norm{remark}"
        ),
    )


def require_kept(slack: FloatArray, structures: ConsistentStructures, specification: Specification) -> None:
    """Refuse a controller that plants through the points do not keep.

    Parameters
    ----------
    slack : (S, 3) array
        Slacks of modulus, phase and delay margin on S plants.
    structures : ConsistentStructures
        What the points allow; says where to measure.
    specification : Specification
        For the message.

    Raises
    ------
    DesignError
        A margin is missed; names the frequency to measure.
    """
    if np.min(slack) >= -2.0 * TOLERANCE:
        return
    raise DesignError(
        f"no controller was found that keeps M_m {specification.modulus_margin:g} and "
        f"{np.degrees(specification.phase_margin_rad):g} deg on all plants of low order through the points",
        where="points",
        remedy=f"relax the margins, or {where_to_measure(structures)}",
    )


def _as_seen(
    margins: Margins, members: Members, controller: PIDController, structures: ConsistentStructures
) -> tuple[Margins, str]:
    """Return margins with phase and delay as far as points tell of them, and what is to be said of them.

    Where a plant crosses over below the lowest point its phase there is extrapolated. No loop of modulus margin M_m
    has a phase margin below 2 asin(M_m/2) (Åström and Hägglund, Advanced PID Control, sec. 4.6): that is left, and
    that over the frequency of the lowest point, above which no such crossover lies, wherever the plant's own is.
    """
    lowest, highest = float(structures.omega_points[0]), float(structures.omega_points[-1])
    quiet = max([highest, *(_loud_until(s, controller, 1.0 - margins.modulus) for s in members.sampled)])
    digit = 10.0 ** (math.floor(math.log10(quiet)) - 2)
    remark = (
        f"; points bound these plants from {lowest:.3g} to {highest:.3g} rad/s; below and above, margins rest on the "
        f"plants alone, from {math.ceil(quiet / digit) * digit:.3g} rad/s on no longer on their phase, since abs(L) is "
        "at most 1 - M_m there"
    )
    if not any(np.any(crossovers(s, controller) < lowest) for s in members.sampled):
        return margins, remark
    phase = 2.0 * math.asin(min(margins.modulus / 2.0, 1.0))
    remark += (
        "; the loop crosses over below the lowest point: phase and delay margin are what the modulus margin leaves of "
        "them at any crossover there, a point measured there shows more"
    )
    delay = min(margins.delay_s, phase / lowest)
    return replace(margins, phase_rad=min(margins.phase_rad, phase), delay_s=delay), remark


def _loud_until(plant: SampledPlant, controller: PIDController, most: float) -> float:
    """Return the frequency of the plant's grid [rad/s] from which on abs(L) is at most so much, or its last one."""
    loud = np.flatnonzero(np.abs(plant.h * controller.response(plant.omega)) > most)
    after = int(loud[-1]) + 1 if loud.size else 0
    return float(plant.omega[min(after, len(plant.omega) - 1)])


def where_to_measure(structures: ConsistentStructures) -> str:
    """Return in words at which frequency a further point would tell the plants through the points apart."""
    first, last = structures.omega_points[0], structures.omega_points[-1]
    omega = np.geomspace(first / _REACH, last * _REACH, 121)
    response = np.array([plant.response(omega) for plant in structures.plants])
    spread = np.ptp(np.log(np.maximum(np.abs(response), 1e-300)), axis=0)
    turn = np.ptp(np.unwrap(np.angle(response / response[:1]), axis=0), axis=0)
    most = int(np.argmax(spread + turn))
    return (
        f"measure a point at {omega[most]:.3g} rad/s, where the plants that pass through the points differ by a factor "
        f"of {np.exp(spread[most]):.2g} in gain and {np.degrees(turn[most]):.0f} deg in phase"
    )
