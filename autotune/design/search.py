"""Local search of the synthesis: sequential quadratic programming on the sampled plant, constraints made exact."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.kernels import SampledPlant, evaluate, evaluate_grid
from autotune.design.loop import open_loop
from autotune.design.margins import (
    high_frequency_gain,
    modulus_margin,
    noise_amplification,
    phase_and_delay_margin,
)
from autotune.design.specification import Specification
from autotune.errors import DesignError
from autotune.models import TransferFunction

_TOLERANCE = 1e-6
_CORRECTIONS = 6


def slacks(modulus: float, phase: float, delay: float, noise: float, specification: Specification) -> FloatArray:
    """Return (4,) relative slacks: modulus margin, phase margin, noise gain, delay margin; negative is violated.

    ``noise`` is the true gain (15), or the gain of (16), as the specification asks.
    """
    allowed = specification.noise_gain if specification.noise == "true" else specification.largest_gain
    asked = specification.delay_margin_s
    return np.array(
        [
            modulus / specification.modulus_margin - 1.0,
            phase / specification.phase_margin_rad - 1.0,
            1.0 - noise / allowed,
            delay / asked - 1.0 if asked > 0.0 else math.inf,
        ]
    )


def _exact_slacks(
    H: TransferFunction, controller: PIDController, specification: Specification, *, stable: bool
) -> FloatArray:
    loop = open_loop(H, controller)
    omega = loop.grid
    L = loop.response(omega)
    modulus = modulus_margin(loop, omega, L)[0]
    phase, delay, crossover = phase_and_delay_margin(loop, omega, L)
    noise = high_frequency_gain(controller, loop, 0.0)
    if specification.noise == "true":
        start = specification.noise_frequency_rad_s
        noise = noise_amplification(
            loop, omega, crossover if start is None and math.isfinite(crossover) else start or 0.0
        )
    return slacks(modulus if stable else -modulus, phase, delay, noise, specification)


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


def evaluate_on(sampled: SampledPlant, grid: FloatArray, specification: Specification) -> FloatArray:
    """Return :func:`evaluate_grid` of the (M, 4) controllers on the sampled plant."""
    omega_n = specification.noise_frequency_rad_s
    return np.asarray(
        evaluate_grid(
            sampled.omega, sampled.h, sampled.weights, sampled.turn, grid, -1.0 if omega_n is None else omega_n
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
        figures = evaluate_on(sampled, parameters[None, :], specification)
        exact = _exact_slacks(H, controller, specification, stable=figures[0, 1] > 0.0)
        if float(np.min(exact)) >= -_TOLERANCE and (best is None or norm < best[0]):
            best = (norm, controller)
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
            remedy="relax the margins by a thousandth, or report the plant",
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
    data = (sampled.omega, sampled.h, sampled.weights, sampled.turn)
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
        # the stubs know no inequality constraint with its own gradient
        result = minimize(  # type: ignore[call-overload] # see above
            lambda z: look(z)[0],
            x,
            jac=lambda z: _gradient(lambda v: np.array([look(v)[0]]), z)[0],
            constraints={
                "type": "ineq",
                "fun": lambda z: look(z)[1][:active],
                "jac": lambda z: _gradient(lambda v: look(v)[1][:active], z),
            },
            bounds=[(float(value) - span, float(value) + span) for value in x],
            method="SLSQP",
            options={"maxiter": 60, "ftol": 1e-12},
        )
        x = np.log(best[1][free] / start[free]) if best[0] < math.inf else np.asarray(result.x)
    return math.sqrt(best[0]), best[1]


def _gradient(f: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    step = 1e-6
    columns = [(f(x + step * e) - f(x - step * e)) / (2.0 * step) for e in np.eye(len(x))]
    return np.stack(columns, axis=-1)
