"""Fixed-structure synthesis (17)-(18): the PI or PID that minimises the H2 norm (11) under the constraints.

A coarse grid finds every basin, sequential quadratic programming goes to its bottom, and the constraints are corrected
until they hold for margins refined between the grid's frequencies.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.kernels import SampledPlant, evaluate, evaluate_grid, sampled_plant
from autotune.design.loop import Plant, transfer_function_of
from autotune.design.margins import Margins, margins
from autotune.design.specification import Design, Kind, Specification
from autotune.errors import DesignError
from autotune.models import TransferFunction

_TOLERANCE = 1e-6
_CORRECTIONS = 6
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
    For PI the coarse grid (about 2000 controllers over five decades of K and four of T_I) makes a missed basin
    unlikely and the certificate rules it out. For PID the result is the best of several local searches, no proof of
    a global optimum.

    References
    ----------
    Le & Mendes 2010, equations (11) to (18) and (25).
    """
    H = transfer_function_of(plant)
    sampled = sampled_plant(H)
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

        bound, statement = lower_bound(sampled, specification, controller, m.h2)
    return Design(
        kind=kind,
        controller=weighted(controller, specification),
        specification=specification,
        h2=m.h2,
        h2_lower_bound=bound,
        binding=binding_constraints(m, controller, specification),
        margins=m,
        certificate=statement,
    )


def weighted(controller: PIDController, specification: Specification) -> PIDController:
    """Return the controller with the largest set-point weight that keeps the immediate set-point command."""
    weight = min(1.0, specification.setpoint_command / max(abs(controller.K), 1e-300))
    return replace(controller, setpoint_weight=weight)


def slacks(m: Margins, controller: PIDController, specification: Specification) -> FloatArray:
    """Return (4,) relative slacks: modulus margin, phase margin, noise gain, delay margin; negative is violated."""
    noise = (
        m.noise_gain / specification.noise_gain
        if specification.noise == "true"
        else m.noise_gain_bound * m.modulus / specification.largest_gain
    )
    delay = m.delay_s / specification.delay_margin_s - 1.0 if specification.delay_margin_s > 0.0 else math.inf
    modulus = m.modulus if m.stable else -m.modulus
    return np.array(
        [
            modulus / specification.modulus_margin - 1.0,
            m.phase_rad / specification.phase_margin_rad - 1.0,
            1.0 - noise,
            delay,
        ]
    )


def binding_constraints(m: Margins, controller: PIDController, specification: Specification) -> tuple[str, ...]:
    """Return the names of the constraints that hold with equality (to within 1e-4)."""
    slack = slacks(m, controller, specification)
    return tuple(name for name, value in zip(_NAMES, slack, strict=True) if abs(value) < 1e-4)


def evaluated_slacks(figures: FloatArray, parameters: FloatArray, specification: Specification) -> FloatArray:
    """Return (M, 4) relative slacks of :func:`evaluate_grid`'s (M, 5) figures for the (M, 4) parameters."""
    modulus, phase, delay, noise = figures[:, 1], figures[:, 2], figures[:, 3], figures[:, 4]
    K, Td, Tf = parameters[:, 0], parameters[:, 2], parameters[:, 3]
    if specification.noise == "true":
        noise_slack = 1.0 - noise / specification.noise_gain
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            derivative = np.where(Td > 0.0, Td / Tf, 0.0)
        noise_slack = 1.0 - K * np.maximum(1.0, derivative) / specification.largest_gain
    delay_slack = (
        delay / specification.delay_margin_s - 1.0 if specification.delay_margin_s > 0.0 else np.full(len(K), np.inf)
    )
    return np.stack(
        (
            modulus / specification.modulus_margin - 1.0,
            phase / specification.phase_margin_rad - 1.0,
            noise_slack,
            delay_slack,
        ),
        axis=1,
    )


def gain_range(sampled: SampledPlant, specification: Specification) -> tuple[float, float, float]:
    """Return the largest gain worth looking at, and the frequency [rad/s] and phase limit that it comes from.

    The crossover lies where arg H >= -pi + phi with phi the larger of the phase margin and the angle that the modulus
    margin implies, as arg C < 0; a factor of 20 covers plants whose gain is not monotone.
    """
    phi = max(specification.phase_margin_rad, 2.0 * math.asin(0.5 * specification.modulus_margin))
    most = specification.largest_gain if specification.noise == "bound" else specification.noise_gain * 20.0
    gain = 1.0 / np.abs(sampled.q)
    beyond = np.flatnonzero(sampled.phase <= -math.pi + phi)
    audible = np.flatnonzero(gain * most >= 1.0)
    last = audible[-1] if len(audible) else len(gain) - 1
    at = min(int(beyond[0]) if len(beyond) else last, last) if len(audible) else int(beyond[0]) if len(beyond) else last
    reachable = 20.0 / float(gain[at]) if gain[at] > 0.0 else most
    return min(most, reachable), float(sampled.omega[at]), phi


def _best_pi(H: TransferFunction, sampled: SampledPlant, specification: Specification) -> PIDController:
    largest, omega_ref, _ = gain_range(sampled, specification)
    K = largest * np.geomspace(1e-4, 1.0, 41)
    Ti = np.geomspace(0.02, 400.0, 44) / omega_ref
    grid = np.array([(k, t, 0.0, 0.0) for k in K for t in Ti])
    figures = evaluate_on(sampled, grid, specification)
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


def evaluate_on(sampled: SampledPlant, grid: FloatArray, specification: Specification) -> FloatArray:
    """Return :func:`evaluate_grid` of the (M, 4) controllers on the sampled plant."""
    omega_n = specification.noise_frequency_rad_s
    return np.asarray(
        evaluate_grid(
            sampled.omega, sampled.q, sampled.weights, sampled.turn, grid, -1.0 if omega_n is None else omega_n
        )
    )


def polished(
    H: TransferFunction, sampled: SampledPlant, specification: Specification, starts: FloatArray
) -> PIDController:
    """Return the best controller reached from the (S, 4) starting values, its constraints corrected to the exact ones.

    Parameters with value 0 stay 0.
    """
    offset = np.zeros(4)
    best: tuple[float, PIDController] | None = None
    candidates = starts
    for _ in range(_CORRECTIONS):
        found = [local_search(sampled, specification, start, offset) for start in candidates]
        norm, parameters = min(found, key=lambda item: item[0])
        if not math.isfinite(norm):
            break
        controller = _controller(parameters, sampled.sign)
        m = margins(H, controller, noise_frequency_rad_s=specification.noise_frequency_rad_s)
        exact = slacks(m, controller, specification)
        if float(np.min(exact)) >= -_TOLERANCE and (best is None or m.h2 < best[0]):
            best = (m.h2, controller)
        figures = evaluate_on(sampled, parameters[None, :], specification)
        coarse = evaluated_slacks(figures, parameters[None, :], specification)[0]
        with np.errstate(invalid="ignore"):
            step = np.where(np.isfinite(coarse), coarse - exact, 0.0)
        if best is not None and np.max(np.abs(step - offset)) < 0.3 * _TOLERANCE:
            break
        offset = step + 0.3 * _TOLERANCE * (exact < 0.0)
        candidates = parameters[None, :]
    if best is None:
        raise DesignError(
            "the search ended beside the constraints",
            where="synthesis",
            mend="relax the margins by a thousandth, or report the plant",
        )
    return best[1]


def _controller(parameters: FloatArray, sign: float) -> PIDController:
    K, Ti, Td, Tf = (float(value) for value in parameters)
    return PIDController(K=sign * K, Ti_s=Ti, Td_s=Td, Tf_s=Tf)


def local_search(
    sampled: SampledPlant, specification: Specification, start: FloatArray, offset: FloatArray
) -> tuple[float, FloatArray]:
    """Return the norm and the (4,) parameters at a local optimum: sequential quadratic programming in log gains.

    ``offset`` (4,) is added to what the constraints ask for. The norm is infinite where no feasible point was found.
    """
    free = start > 0.0
    omega_n = -1.0 if specification.noise_frequency_rad_s is None else specification.noise_frequency_rad_s
    data = (sampled.omega, sampled.q, sampled.weights, sampled.turn)
    memory: dict[bytes, tuple[float, FloatArray]] = {}
    best: tuple[float, FloatArray] = (math.inf, start)

    def look(x: FloatArray) -> tuple[float, FloatArray]:
        nonlocal best
        key = x.tobytes()
        if key not in memory:
            p = start.copy()
            p[free] = start[free] * np.exp(x)
            figures = np.array(evaluate(*data, p[0], p[1], p[2], p[3], omega_n))
            slack = evaluated_slacks(figures[None, :], p[None, :], specification)[0] - offset
            slack = np.minimum(slack, 10.0)
            memory[key] = (0.5 * math.log(figures[0]), slack)
            if np.min(slack) >= -1e-9 and figures[0] < best[0]:
                best = (float(figures[0]), p)
        return memory[key]

    active = 4 if specification.delay_margin_s > 0.0 else 3
    x = np.zeros(int(np.sum(free)))
    for span in (1.0, 0.05):
        result = minimize(
            lambda z: look(z)[0],
            x,
            jac=lambda z: _gradient(lambda v: np.array([look(v)[0]]), z)[0],
            constraints={
                "type": "ineq",
                "fun": lambda z: look(z)[1][:active],
                "jac": lambda z: _gradient(lambda v: look(v)[1][:active], z),
            },
            bounds=[(value - span, value + span) for value in x],
            method="SLSQP",
            options={"maxiter": 60, "ftol": 1e-12},
        )
        if best[0] < math.inf:
            x = np.log(best[1][free] / start[free])
        else:
            x = np.asarray(result.x)
    return math.sqrt(best[0]), best[1]


def _gradient(f: object, x: FloatArray) -> FloatArray:
    step = 1e-6
    columns = [(f(x + step * e) - f(x - step * e)) / (2.0 * step) for e in np.eye(len(x))]  # type: ignore[operator] # a callable
    return np.stack(columns, axis=-1)


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
            mend=f"raise the noise gain above {specification.noise_gain:g}, or use another structure",
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
        mend=f"the nearest that one reaches is {near}",
    )
