"""Local search of the synthesis: sequential quadratic programming on sampled plants, constraints made exact."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.corners import out_of_corner
from autotune.design.figures import Figures, columns
from autotune.design.kernels import SampledPlant, evaluate, evaluate_grid
from autotune.design.loop import open_loop
from autotune.design.margins import (
    controller_gain,
    modulus_margin,
    noise_amplification,
    phase_and_delay_margin,
)
from autotune.design.specification import Specification
from autotune.errors import DesignError
from autotune.models import TransferFunction

_TOLERANCE = 1e-6
CORRECTIONS = 6
_TIGHTER = (1e-4, 1e-3, 0.01, 0.03)
_PI_GAINS = 2
MOST_SLACK = 10.0  # what is not asked for has infinite slack, which has no derivative


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Plants on which one controller keeps one specification; norm and noise gain are the first one's.

    Attributes
    ----------
    plants : tuple of TransferFunction
        Exact. The margins are kept on all of them; noise wears an actuator and does not endanger a loop, so that its
        gain is kept on the first, the estimate.
    sampled : tuple of SampledPlant
        The same on their grids.
    specification : Specification
        Constraints (18).
    """

    plants: tuple[TransferFunction, ...]
    sampled: tuple[SampledPlant, ...]
    specification: Specification

    @property
    def omega_n(self) -> float:
        """Lowest frequency of the noise [rad/s] as the kernels take it: -1 for the crossover."""
        asked = self.specification.noise_frequency_rad_s
        return -1.0 if asked is None else asked

    def norms_and_slacks(self, grid: FloatArray, thin: int = 1) -> tuple[FloatArray, FloatArray]:
        """Return (M,) squared norms on the first plant and (M, S, 4) slacks on all plants of the (M, 4) controllers.

        Parameters
        ----------
        grid : (M, 4) array
            Rows of K, T_I, T_d, T_f, sign taken out, times in s.
        thin : int
            Every ``thin``-th frequency is looked at.
        """
        found = []
        for plant in self.sampled:
            s = plant.thinned(thin) if thin > 1 else plant
            found.append(columns(evaluate_grid(s.omega, s.h, s.weights, s.turn, grid, self.omega_n)))
        slacks = np.stack([self.slacks_of(i, figures) for i, figures in enumerate(found)], axis=1)
        return np.asarray(found[0].squared_norm), slacks

    def figures_at(self, parameters: FloatArray) -> list[Figures]:
        """Return the figures of one controller, its (4,) parameters as in :meth:`norms_and_slacks`, on each plant."""
        return [evaluate(s.omega, s.h, s.weights, s.turn, *parameters, self.omega_n) for s in self.sampled]

    def slacks_at(self, parameters: FloatArray) -> FloatArray:
        """Return the (S, 4) slacks of one controller, its (4,) parameters as in :meth:`norms_and_slacks`."""
        return np.array([self.slacks_of(i, figures) for i, figures in enumerate(self.figures_at(parameters))])

    def slacks_of(self, plant: int, figures: Figures) -> FloatArray:
        """Return the slacks of the figures on a plant.

        Parameters
        ----------
        plant : int
            Which one; the first alone is held to the noise gain.
        figures : Figures
            Each of shape (...).

        Returns
        -------
        (..., 4) array
            Slacks of modulus, phase, noise gain and delay; infinite where nothing is asked.
        """
        slacks = self.specification.slacks(figures)
        if plant > 0:
            slacks[..., 2] = np.inf
        return slacks

    def exact_slacks(self, parameters: FloatArray, coarse: FloatArray) -> FloatArray:
        """Return (S, 4) slacks refined between the grid's frequencies.

        Whether a loop is stable is taken from the grid's count: a negative modulus margin.

        Parameters
        ----------
        parameters : (4,) array
            K, T_I, T_d, T_f, sign taken out, times in s.
        coarse : (S, 4) array
            Slacks on the grids.
        """
        controller = self.controller(parameters)
        found = [
            _exact_figures(plant, controller, self.specification, stable=bool(slack > -1.0))
            for plant, slack in zip(self.plants, coarse[:, 0], strict=True)
        ]
        return np.array([self.slacks_of(i, figures) for i, figures in enumerate(found)])

    def corrected(self, parameters: FloatArray, offset: FloatArray) -> tuple[FloatArray, bool]:
        """Return what the constraints on the grids must be shifted by to be the exact ones, and whether one is missed.

        Parameters
        ----------
        parameters : (4,) array
            K, T_I, T_d, T_f, sign taken out, times in s.
        offset : (S, 4) array
            What they were shifted by.
        """
        coarse = self.slacks_at(parameters)
        exact = self.exact_slacks(parameters, coarse)
        with np.errstate(invalid="ignore"):
            step = np.where(np.isfinite(coarse), coarse - exact, 0.0)
        return step + 0.3 * _TOLERANCE * (exact < 0.0), bool(np.min(exact) < -_TOLERANCE)

    def kept(self, parameters: FloatArray) -> bool:
        """Whether all plants keep the specification exactly."""
        coarse = self.slacks_at(parameters)
        return bool(np.min(self.exact_slacks(parameters, coarse)) >= -_TOLERANCE)

    def controller(self, parameters: FloatArray) -> PIDController:
        """Return the controller of (4,) parameters, with the plant's sign."""
        K, Ti, Td, Tf = (float(value) for value in parameters)
        return PIDController(K=self.sampled[0].sign * K, Ti_s=Ti, Td_s=Td, Tf_s=Tf)


def _exact_figures(
    H: TransferFunction, controller: PIDController, specification: Specification, *, stable: bool
) -> Figures:
    loop = open_loop(H, controller)
    omega = loop.grid
    L = loop.response(omega)
    modulus = modulus_margin(loop, omega, L)[0]
    phase, delay, crossover = phase_and_delay_margin(loop, omega, L)
    start = specification.noise_frequency_rad_s
    if start is None:
        start = crossover if math.isfinite(crossover) else float(omega[0])
    return Figures(
        squared_norm=math.nan,
        modulus=modulus if stable else -modulus,
        phase_rad=phase,
        delay_s=delay,
        noise_gain=noise_amplification(loop, omega, start),
        controller_gain=controller_gain(loop, start),
    )


def polish(problem: Problem, starts: FloatArray) -> PIDController:
    """Return the best controller reached from the starting values, its constraints corrected to the exact ones.

    Parameters with value 0 stay 0. Where the corrections do not settle on the feasible side, a little more is asked
    for, and where no search ends there, the best of the starting values that is feasible exactly is returned.

    Parameters
    ----------
    problem : Problem
        Plants and constraints.
    starts : (S, 4) array
        Rows of K, T_I, T_d, T_f, sign taken out, times in s; a 0 stays 0.

    Raises
    ------
    DesignError
        Not even a starting value keeps the constraints between the frequencies of the grid.
    """
    best = _search_corrected(problem, starts)
    if best is not None and np.sum(best > 0.0) == _PI_GAINS:
        best = out_of_corner(problem, best)
    shape = (len(problem.plants), 4)
    for more in _TIGHTER if best is None else ():
        norm, parameters = _best_of(problem, starts, np.full(shape, more))
        if math.isfinite(norm) and problem.kept(parameters):
            best = parameters
            break
    if best is None:
        best = next((start for start in starts if problem.kept(start)), None)
    if best is None:
        raise DesignError(
            "no controller was found that keeps the constraints between the frequencies of the search",
            where="synthesis",
            remedy="relax the margins by a hundredth",
        )
    return problem.controller(best)


def _search_corrected(problem: Problem, starts: FloatArray) -> FloatArray | None:
    """Return the best parameters, the constraints on the grid shifted until they are the exact ones; None if none."""
    offset = np.zeros((len(problem.plants), 4))
    best: tuple[float, FloatArray] | None = None
    candidates = starts
    for _ in range(CORRECTIONS):
        norm, parameters = _best_of(problem, candidates, offset)
        if not math.isfinite(norm):
            break
        before, (offset, missed) = offset, problem.corrected(parameters, offset)
        if not missed and (best is None or norm < best[0]):
            best = (norm, parameters)
        if best is not None and np.max(np.abs(offset - before)) < 0.3 * _TOLERANCE:
            break
        candidates = parameters[None, :]
    return None if best is None else best[1]


def _best_of(problem: Problem, starts: FloatArray, offset: FloatArray) -> tuple[float, FloatArray]:
    return min((_local_search(problem, start, offset) for start in starts), key=lambda item: item[0])


def _local_search(problem: Problem, start: FloatArray, offset: FloatArray) -> tuple[float, FloatArray]:
    """Return the norm and the (4,) parameters at a local optimum: sequential quadratic programming in log gains.

    ``offset`` (S, 4) is added to what the constraints ask for. The norm is infinite where no feasible point was found.
    """
    free = start > 0.0
    specification = problem.specification
    asked = [0, 1, 2, 3] if specification.delay_margin_s > 0.0 else [0, 1, 2]
    best: tuple[float, FloatArray] = (math.inf, start)

    def look(x: FloatArray) -> tuple[float, FloatArray]:
        nonlocal best
        p = start.copy()
        p[free] = start[free] * np.exp(x)
        found = problem.figures_at(p)
        slack = np.array([problem.slacks_of(i, figures) for i, figures in enumerate(found)]) - offset
        slack = np.minimum(slack[:, asked], MOST_SLACK).ravel()
        squared = float(found[0].squared_norm)
        if np.min(slack) >= -1e-9 and squared < best[0]:
            best = (squared, p)
        return 0.5 * math.log(squared), slack

    x = np.zeros(int(np.sum(free)))
    for span in (1.0, 0.05):
        ended = minimise(look, x, span, most=60, tolerance=1e-12)
        x = np.log(best[1][free] / start[free]) if best[0] < math.inf else ended
    return math.sqrt(best[0]), best[1]


def minimise(
    look: Callable[[FloatArray], tuple[float, FloatArray]],
    start: FloatArray,
    span: float,
    *,
    most: int,
    tolerance: float,
) -> FloatArray:
    """Return where sequential quadratic programming ends: value and slacks of ``look``, within ``span`` of the start.

    Parameters
    ----------
    look : callable
        From (P,) parameters to what is minimised and its (S,) slacks, negative where violated; asked once at each.
    start : (P,) array
        Where it begins.
    span : float
        Largest distance from the start in each parameter.
    most : int
        Largest number of steps.
    tolerance : float
        Of the value.
    """
    seen: dict[bytes, tuple[float, FloatArray]] = {}

    def look_once(z: FloatArray) -> tuple[float, FloatArray]:
        # value, slacks and the gradients of both are asked for apart, at the same points
        key = z.tobytes()
        if key not in seen:
            seen[key] = look(z)
        return seen[key]

    # the stubs know no inequality constraint with its own gradient
    result = minimize(  # type: ignore[call-overload] # see above
        lambda z: look_once(z)[0],
        start,
        jac=lambda z: _gradient(lambda v: np.array([look_once(v)[0]]), z)[0],
        constraints={
            "type": "ineq",
            "fun": lambda z: look_once(z)[1],
            "jac": lambda z: _gradient(lambda v: look_once(v)[1], z),
        },
        bounds=[(float(value) - span, float(value) + span) for value in start],
        method="SLSQP",
        options={"maxiter": most, "ftol": tolerance},
    )
    return np.asarray(result.x)


def _gradient(f: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    step = 1e-6
    columns_ = [(f(x + step * e) - f(x - step * e)) / (2.0 * step) for e in np.eye(len(x))]
    return np.stack(columns_, axis=-1)
