"""Fixed-structure synthesis (17)-(18): the PI or PID that minimises the H2 norm (11) under the constraints.

A coarse grid finds every basin, sequential quadratic programming goes to its bottom, and the constraints are corrected
until they hold for margins refined between the grid's frequencies.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.kernels import SampledPlant, sampled_plant
from autotune.design.loop import Plant, transfer_function_of
from autotune.design.margins import Margins, margins
from autotune.design.search import evaluate_on, evaluated_slacks, polished, slacks
from autotune.design.specification import Design, Kind, Specification
from autotune.errors import DesignError
from autotune.models import TransferFunction

_NAMES = ("modulus margin", "phase margin", "noise gain", "delay margin")


def design(plant: Plant, specification: Specification, kind: Kind = "pi", *, certificate: bool = True) -> Design:
    """Return the controller with the smallest H2 norm (11) among those that meet the specification.

    Parameters
    ----------
    plant : TransferFunction or Model
        H with exact dead time; of a model its blocks, without its effects.
    specification : Specification
        Constraints (18).
    kind : {"pi", "pid"}
        PI of (25), or PID with a first-order measurement filter.
    certificate : bool
        Whether to prove a lower bound on the norm (PI only; some tenths of a second).

    Returns
    -------
    Design
        Frozen; its margins hold to within 1e-6 of what was asked.

    Raises
    ------
    DesignError
        The plant has no low-frequency gain, or nothing of this structure meets the specification: the message names
        the nearest specification that can be met.

    Notes
    -----
    For PI the coarse grid (about 1200 controllers over five decades of K and four of T_I) makes a missed basin
    unlikely and the certificate rules it out. For PID the result is the best of several local searches, no proof of
    a global optimum.

    References
    ----------
    Le & Mendes 2010, equations (11) to (18) and (25).
    """
    H = transfer_function_of(plant)
    most = specification.largest_gain if specification.noise == "bound" else specification.noise_gain
    sampled = sampled_plant(H, most)
    pi = _best_pi(H, sampled, specification)
    if kind == "pid":
        from autotune.design.pid import best_pid

        controller = best_pid(H, sampled, specification, pi)
        bound, statement = None, "no lower bound: four gains are searched locally from several starts"
    else:
        controller = pi
        bound, statement = None, "no lower bound asked for"
    m = margins(H, controller, noise_frequency_rad_s=specification.noise_frequency_rad_s)
    if kind == "pi" and certificate:
        from autotune.design.certificate import lower_bound

        bound, statement = lower_bound(H, sampled, specification, controller, m)
    return Design(
        kind=kind,
        controller=weighted(controller, specification),
        specification=specification,
        h2=m.h2,
        h2_lower_bound=bound,
        binding=binding_constraints(m, specification),
        margins=m,
        certificate=statement,
    )


def weighted(controller: PIDController, specification: Specification) -> PIDController:
    """Return the controller with the largest set-point weight that keeps the immediate set-point command."""
    weight = min(1.0, specification.setpoint_command / max(abs(controller.K), 1e-300))
    return replace(controller, setpoint_weight=weight)


def binding_constraints(m: Margins, specification: Specification) -> tuple[str, ...]:
    """Return the names of the constraints that hold with equality (to within 1e-4)."""
    noise = m.noise_gain if specification.noise == "true" else m.noise_gain_bound * m.modulus
    slack = slacks(m.modulus if m.stable else -m.modulus, m.phase_rad, m.delay_s, noise, specification)
    return tuple(name for name, value in zip(_NAMES, slack, strict=True) if abs(value) < 1e-4)


def gain_range(sampled: SampledPlant, specification: Specification) -> tuple[float, float, float]:
    """Return the largest gain worth looking at, and the frequency [rad/s] and phase limit that it comes from.

    The crossover lies where arg H >= -pi + phi with phi the larger of the phase margin and the angle that the modulus
    margin implies, as arg C < 0; a factor of 20 covers plants whose gain is not monotone.
    """
    phi = max(specification.phase_margin_rad, 2.0 * math.asin(0.5 * specification.modulus_margin))
    most = specification.largest_gain if specification.noise == "bound" else specification.noise_gain * 20.0
    gain = np.abs(sampled.h)
    beyond = np.flatnonzero(sampled.phase <= -math.pi + phi)
    audible = np.flatnonzero(gain * most >= 1.0)
    last = audible[-1] if len(audible) else len(gain) - 1
    at = min(int(beyond[0]) if len(beyond) else last, last) if len(audible) else int(beyond[0]) if len(beyond) else last
    reachable = 20.0 / float(gain[at]) if gain[at] > 0.0 else most
    return min(most, reachable), float(sampled.omega[at]), phi


def _best_pi(H: TransferFunction, sampled: SampledPlant, specification: Specification) -> PIDController:
    largest, omega_ref, _ = gain_range(sampled, specification)
    K = largest * np.geomspace(1e-4, 1.0, 33)
    Ti = np.geomspace(0.02, 400.0, 36) / omega_ref
    grid = np.array([(k, t, 0.0, 0.0) for k in K for t in Ti])
    figures = evaluate_on(sampled.thinned(4), grid, specification)
    slack = evaluated_slacks(figures, grid, specification)
    feasible = np.min(slack, axis=1) >= -1e-12
    if not np.any(feasible):
        raise _unreachable(H, sampled, specification, grid, slack)
    starts = grid[feasible][np.argsort(figures[feasible, 0])]
    return polished(H, sampled, specification, starts[_separate(starts)])


def _separate(starts: FloatArray) -> list[int]:
    """Return up to two of the best grid nodes that are not neighbours: one start for each of two basins."""
    far = np.flatnonzero(np.max(np.abs(np.log(starts[:, :2] / starts[0, :2])), axis=1) > 0.8)
    return [0, int(far[0])] if len(far) else [0]


def _unreachable(
    H: TransferFunction, sampled: SampledPlant, specification: Specification, grid: FloatArray, slack: FloatArray
) -> DesignError:
    """Return the error that names the nearest specification: margins shrunk by one common factor, noise kept."""
    usable = slack[:, 2] >= 0.0
    share = np.where(usable, 1.0 + np.min(slack[:, [0, 1, 3]], axis=1), -np.inf)
    best = int(np.argmax(share))
    if share[best] <= 0.0:
        return DesignError(
            "no PI of the plant's sign within the noise gain stabilises this plant",
            where="synthesis",
            remedy=f"raise the noise gain above {specification.noise_gain:g}, or use another structure",
        )
    factor = math.floor(float(share[best]) * 1000.0) / 1000.0
    asked = f"M_m {specification.modulus_margin:g}, {math.degrees(specification.phase_margin_rad):g} deg"
    near = (
        f"M_m {factor * specification.modulus_margin:.3f}, "
        f"{factor * math.degrees(specification.phase_margin_rad):.1f} deg"
    )
    if specification.delay_margin_s > 0.0:
        asked += f", delay margin {specification.delay_margin_s:g} s"
        near += f", delay margin {factor * specification.delay_margin_s:.4g} s"
    return DesignError(
        f"no PI reaches {asked} with noise gain {specification.noise_gain:g}",
        where="synthesis",
        remedy=f"the nearest that one reaches is {near}",
    )
