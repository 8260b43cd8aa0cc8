"""Fixed-structure synthesis (17)-(18): the PI or PID that minimises the H2 norm (11) under the constraints.

A coarse grid looks for basins, sequential quadratic programming goes to the bottom of the best ones, and the
constraints are corrected until they hold for margins refined between the grid's frequencies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.kernels import SampledPlant, sampled_plant
from autotune.design.load_error import least_error, load_step, settle
from autotune.design.loop import Plant, transfer_function_of
from autotune.design.margins import margins
from autotune.design.search import CORRECTIONS, Problem, polish
from autotune.design.search_starts import admissible, separate
from autotune.design.specification import Design, Kind, Specification
from autotune.errors import DesignError

_STARTS = 4
#: nodes that keep nothing and are led towards what is asked for
_LED = 4
#: share of the gains by which a step moves them that is none
_STILL = 1e-8
#: margins between the grid's frequencies are exact to this; what is missed by more is never handed out
_MISSED = 1e-3
#: a proportional part that is nowhere more than this of the loop does nothing: the controller is an integral one
_NO_PROPORTION = 5e-3
#: what is given of the integral gain so that a proportional part of that size keeps the constraints
_GIVEN = (1.0, 0.999, 0.997, 0.99, 0.97)


def design(
    plant: Plant,
    specification: Specification,
    kind: Kind = "pi",
    *,
    also: Sequence[Plant] = (),
    certificate: bool = True,
) -> Design:
    """Return the controller with the smallest H2 norm (11) among those that meet the specification.

    Parameters
    ----------
    plant : TransferFunction or Model
        H with exact dead time; of a model its blocks, without its effects.
    specification : Specification
        Constraints (18).
    kind : {"pi", "pid"}
        PI of (25), or PID with a first-order measurement filter.
    also : sequence of TransferFunction or Model
        Further plants that keep the margins with the same controller: what a model may be besides its estimate. The
        noise gain is kept on ``plant``.
    certificate : bool
        Whether to prove a lower bound on the norm (PI only; some tenths of a second).

    Returns
    -------
    Design
        Frozen; its margins, those of the worst plant, hold to within 1e-6 of what was asked. The norm is ``plant``'s.

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
    plants = tuple(transfer_function_of(one) for one in (plant, *also))
    H = plants[0]
    problem = Problem(
        plants=plants,
        sampled=tuple(sampled_plant(one, specification.largest_gain) for one in plants),
        specification=specification,
    )
    if len({one.sign for one in problem.sampled}) > 1:
        raise DesignError("the plants' gains are of both signs", where="synthesis", remedy="measure the gain better")
    controller = _best_pi(problem) if kind == "pi" else _best_pid(problem)
    bound, statement = None, "no lower bound asked for"
    if kind == "pid":
        statement = "no lower bound: four gains are searched locally from several starts"
    if specification.criterion == "iae":
        controller = _least_error(problem, controller)
    integral = _as_integral(problem, controller)
    controller = controller if integral is None else integral
    found = [margins(one, controller, noise_frequency_rad_s=specification.noise_frequency_rad_s) for one in plants]
    slacks = [float(np.min(problem.slacks_of(i, m.figures))) for i, m in enumerate(found)]
    worst = found[int(np.argmin(slacks))]
    if min(slacks) < -_MISSED:
        raise DesignError(
            f"the best controller found misses the constraints on closer look (M_m {worst.modulus:.3f},"
            f" {math.degrees(worst.phase_rad):.1f} deg{'' if worst.stable else ', unstable'})",
            where="synthesis",
            remedy="relax the margins by a hundredth",
        )
    if kind == "pi" and certificate:
        from autotune.design.certificate import lower_bound

        bound, statement = lower_bound(H, problem.sampled[0], specification, controller, found[0])
    return Design(
        kind=kind,
        controller=weight_set_point(controller, specification),
        specification=specification,
        h2=found[0].h2,
        h2_lower_bound=bound,
        binding=tuple(dict.fromkeys(name for m in found for name in specification.binding(m.figures))),
        margins=worst,
        certificate=statement,
        is_integral=integral is not None,
    )


def _as_integral(problem: Problem, controller: PIDController) -> PIDController | None:
    """Return an integral controller as a PI that a device can hold; None where the proportional part does something.

    On a plant with a resonance or little but dead time the best PI has K = 0. A search in logarithms of the gains comes
    as near to that as it has steps, and its K says nothing; this one's is as large as can be without changing the loop.
    """
    if controller.kind != "pi":
        return None
    largest = max(float(np.max(np.abs(one.h))) for one in problem.sampled)
    K = math.copysign(_NO_PROPORTION / largest, controller.K)
    if abs(controller.K) >= abs(K):
        return None
    for share in _GIVEN:
        Ti = K / (share * controller.K / controller.Ti_s)
        if problem.kept(np.array([abs(K), Ti, 0.0, 0.0])):
            return PIDController(K=K, Ti_s=Ti)
    return None


def _least_error(problem: Problem, controller: PIDController) -> PIDController:
    """Return the controller of the least absolute error near that of the least norm, the constraints kept exactly."""
    H, sampled = problem.plants[0], problem.sampled[0]
    start = np.array([abs(controller.K), controller.Ti_s, controller.Td_s, controller.Tf_s])
    crossover = margins(H, controller).crossover_rad_s
    load = load_step(lambda omega: np.asarray(sampled.sign * H.response(omega)), start, crossover, H.delay_s)

    def slacks(p: FloatArray) -> FloatArray:
        return np.asarray(problem.slacks_at(p) - offset)

    offset, best = np.zeros((len(problem.plants), 4)), start
    p = least_error(load, slacks, start)
    for _ in range(CORRECTIONS):
        offset, missed = problem.corrected(p, offset)
        if not missed and load.error(p) < load.error(best):
            best = p
        before, p = p, settle(load, slacks, p)
        if np.allclose(p, before, rtol=_STILL, atol=0.0):
            break
    return problem.controller(best)


def weight_set_point(controller: PIDController, specification: Specification) -> PIDController:
    """Return the controller with the largest set-point weight that keeps the immediate set-point command.

    Parameters
    ----------
    controller : PIDController
        Its gain stays.
    specification : Specification
        States the largest command that a unit step of the set-point may give.
    """
    weight = min(1.0, specification.setpoint_command / max(abs(controller.K), 1e-300))
    return replace(controller, setpoint_weight=weight)


def _gain_range(sampled: SampledPlant, specification: Specification) -> tuple[float, float, float]:
    """Return the largest gain worth looking at, and the frequency [rad/s] and phase limit that it comes from.

    The crossover lies where arg H >= -pi + phi with phi the larger of the phase margin and the angle that the modulus
    margin implies, as arg C < 0; a factor of 20 covers plants whose gain is not monotone. The phase of an unstable
    plant begins at -pi and rises: the frequency is where it falls below that limit again, or is largest.
    """
    phi = max(specification.phase_margin_rad, 2.0 * math.asin(0.5 * specification.modulus_margin))
    most = specification.largest_gain
    gain = np.abs(sampled.h)
    phase = sampled.phase
    within = np.flatnonzero(phase > -math.pi + phi)
    start = int(within[0]) if len(within) else int(np.argmax(phase))
    beyond = start + np.flatnonzero(phase[start:] <= -math.pi + phi)
    audible = np.flatnonzero(gain * most >= 1.0)
    last = audible[-1] if len(audible) else len(gain) - 1
    at = min(int(beyond[0]) if len(beyond) else last, last) if len(audible) else int(beyond[0]) if len(beyond) else last
    reachable = 20.0 / float(gain[at]) if gain[at] > 0.0 else most
    return min(most, reachable), float(sampled.omega[at]), phi


def _best_pi(problem: Problem) -> PIDController:
    largest, omega_ref, _ = _gain_range(problem.sampled[0], problem.specification)
    K = largest * np.geomspace(1e-4, 1.0, 33)
    Ti = np.geomspace(0.02, 400.0, 36) / omega_ref
    grid = np.array([(k, t, 0.0, 0.0) for k in K for t in Ti])
    norms, slacks = problem.norms_and_slacks(grid, thin=4)
    slack = np.min(slacks, axis=1)
    least = np.min(slack, axis=1)
    feasible = least >= -1e-12
    if np.any(feasible):
        return polish(problem, separate(grid[feasible][np.argsort(norms[feasible])], 0.8, _STARTS))
    starts = admissible(problem, separate(grid[np.argsort(-least)], 0.4, _LED))
    if not len(starts):
        raise _unreachable(problem.specification, slack)
    return polish(problem, starts)


def _best_pid(problem: Problem) -> PIDController:
    """Return the best PID; a PI is one of them, and where there is none a PID may still be."""
    from autotune.design.pid import best_pid

    pi, refused = None, None
    try:
        pi = _best_pi(problem)
    except DesignError as error:
        refused = error
    largest, omega_ref, _ = _gain_range(problem.sampled[0], problem.specification)
    found = best_pid(problem, pi, largest, omega_ref)
    if found is not None:
        return found
    assert refused is not None
    raise DesignError(f"{refused.what}, and no PID was found that does", where=refused.where, remedy=refused.remedy)


def _unreachable(specification: Specification, slack: FloatArray) -> DesignError:
    """Return the error that names the nearest specification: margins shrunk by one common factor, noise kept."""
    usable = slack[:, 2] >= 0.0
    safe = np.min(slack[:, [0, 1, 3]], axis=1) >= 0.0
    if not np.any(safe & usable) and np.any(safe):
        least = specification.noise_gain * float(np.min(1.0 - slack[safe, 2]))
        return DesignError(
            f"no PI keeps the noise gain at {specification.noise_gain:g}: with integral action abs(C/(1 + L)) at the "
            "crossover is at least half of the inverse of the plant's gain there",
            where="synthesis",
            remedy=f"allow {1.05 * least:.3g}, or name the frequency from which there is noise",
        )
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
