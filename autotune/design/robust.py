"""Synthesis straight from measured points: margins for every process that agrees with them, no reduced model between.

The prior class and what it allows between and beyond the points are in :mod:`autotune.design.process_class`. At each
frequency the plants form a convex set in the plane of (log gain, phase); the margins are required on the whole set, on
a grid whose spacing is paid for by the class's own bound on curvature.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.controller import PIDController
from autotune.design.corners import plainest
from autotune.design.figures import columns
from autotune.design.kernels import evaluate, evaluate_grid
from autotune.design.load_error import least_error, load_step
from autotune.design.margins import Margins
from autotune.design.members import members_of
from autotune.design.on_fit import ROUNDS, most_missed
from autotune.design.on_structures import design_on_structures, require_kept
from autotune.design.search import minimise
from autotune.design.simplex import search_by_simplex
from autotune.design.specification import PROBABILITY, UNCERTAIN, Design, Kind, Specification
from autotune.design.uncertain import UncertainPlant, guaranteed_figures, uncertain_plant
from autotune.errors import DesignError
from autotune.identification.consistent_structures import consistent_structures
from autotune.points import FrequencyPoint

#: the search begins on every so many-th frequency
_THIN = 4
#: from so many nodes of the coarse grid, apart from each other in log gains
_STARTS, _APART = 2, 0.25
#: where no node is kept: so many are looked at, and the best of them led towards what is asked for, a little inside
_LOOKED, _LED, _INSIDE = 300, 3, 0.002


def design_on_points(points: Sequence[FrequencyPoint], specification: Specification, kind: Kind = "pi") -> Design:
    """Return the controller of the smallest nominal H2 norm whose margins hold for every plant that fits the points.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        At least three, with covariance; they should reach from above the crossover's phase to near -160 degrees.
    specification : Specification
        Constraints (18).
    kind : {"pi", "pid"}
        Structure.

    Returns
    -------
    Design
        Its margins are those that every member has at least; its norm and crossover are the nominal member's.

    Raises
    ------
    DesignError
        The points contradict each other, do not reach far enough, or no controller meets the specification for all
        plants: the message names the nearest specification that can be met.

    Notes
    -----
    The guarantee is conditional on the class: aperiodic processes with dead time, at most one integrator, all-pass
    factors and a zero in the right half plane, which makes the gain rise first. Sets at different frequencies are
    treated as independent, which can only make it stricter.
    """
    if len(points) < 3:
        raise DesignError(f"{len(points)} points", where="points", remedy="a design on points needs at least three")
    of_low_order = consistent_structures(points)
    try:
        plant = uncertain_plant(tuple(points))
    except DesignError:
        if not of_low_order.plants:
            raise
        return design_on_structures(of_low_order, specification, kind)
    members = members_of(of_low_order.plants, specification)
    chosen: list[int] = []
    for _ in range(ROUNDS):
        held = replace(plant, members=members.chosen(chosen).sampled)
        found = _answer(held, specification, kind, _search(held, specification, kind))
        if not members.plants:
            return found
        slack = members.slacks(found.controller, specification)
        worst = most_missed(slack) - set(chosen)
        if not worst:
            break
        chosen += sorted(worst)
    require_kept(slack, of_low_order, specification)
    return replace(found, margins=members.least(found.margins, found.controller))


def _slacks(plant: UncertainPlant, specification: Specification, p: FloatArray) -> FloatArray:
    """Return (4,) relative slacks that every plant of the set has, and the margins that its members have."""
    figures, _ = guaranteed_figures(plant.omega, plant.supports, p[0], p[1], p[2], p[3], _omega_n(specification))
    slacks = np.minimum(specification.slacks(figures), 10.0)
    for s in plant.members:
        other = evaluate(s.omega, s.h, s.weights, s.turn, p[0], p[1], p[2], p[3], -1.0)
        beside = specification.slacks(other)
        beside[2] = np.inf  # the noise gain is the set's
        slacks = np.minimum(slacks, beside)
    return np.asarray(slacks)


def _omega_n(specification: Specification) -> float:
    asked = specification.noise_frequency_rad_s
    return -1.0 if asked is None else asked


def _norm(plant: UncertainPlant, p: FloatArray) -> float:
    n = plant.nominal
    figures = evaluate(n.omega, n.h, n.weights, n.turn, p[0], p[1], p[2], p[3], -1.0)
    return 0.5 * math.log(figures.squared_norm) if figures.modulus > 0.0 else 1e3


def _search(plant: UncertainPlant, specification: Specification, kind: Kind) -> FloatArray:
    """Return the best controller of the structure; a PI is a PID with T_d = 0."""
    found: list[FloatArray] = []
    refused: DesignError | None = None
    structures: tuple[Kind, ...] = ("pi",) if kind == "pi" else ("pid", "pi")
    for structure in structures:
        try:
            found.append(_search_structure(plant, specification, structure))
        except DesignError as error:
            refused = refused or error
    if not found:
        assert refused is not None
        raise refused
    return plainest(
        found, lambda p: _norm(plant, p), lambda p: float(np.min(_slacks(plant, specification, p))) >= -1e-6
    )


def _search_structure(plant: UncertainPlant, specification: Specification, kind: Kind) -> FloatArray:
    """Coarse grid on the nominal plant, the best node that the whole set keeps, then local searches, coarse to fine."""
    coarse = plant.thinned(_THIN)
    grid = _coarse_grid(plant, specification, kind)
    n = coarse.nominal
    figures = columns(evaluate_grid(n.omega, n.h, n.weights, n.turn, grid, _omega_n(specification)))
    promising = np.flatnonzero(np.min(specification.slacks(figures)[:, :2], axis=1) >= -0.05)
    order = promising[np.argsort(np.asarray(figures.squared_norm)[promising])]
    starts = _first_kept(coarse, specification, grid[order]) or _raise_least_slack(coarse, specification, grid[order])
    if not starts:
        raise _unreachable(plant, specification, kind, grid)
    found = [_quadratic(coarse, specification, start, (1.0, 0.1)) for start in starts]
    best = _quadratic(plant, specification, min(found, key=lambda p: _norm(coarse, p)), (0.1, 0.1))
    if np.min(_slacks(plant, specification, best)) < -1e-6:  # feasible between the coarse frequencies only
        best = _quadratic(plant, specification, _inwards(plant, specification, starts[0]), (1.0, 0.1))
    if np.min(_slacks(plant, specification, best)) < -1e-6:
        raise _unreachable(plant, specification, kind, grid)
    if specification.criterion == "iae":
        best = _least_error(plant, specification, np.asarray(best))
    return np.asarray(best)


def _first_kept(plant: UncertainPlant, specification: Specification, nodes: FloatArray) -> list[FloatArray]:
    """Return the first nodes that the whole set keeps and that are no neighbours, two at most."""
    kept: list[FloatArray] = []
    for node in nodes:
        free = node > 0.0
        near = any(float(np.max(np.abs(np.log(node[free] / one[free])))) <= _APART for one in kept)
        if not near and np.min(_slacks(plant, specification, node)) >= 0.0:
            kept.append(node)
        if len(kept) == _STARTS:
            break
    return kept


def _raise_least_slack(plant: UncertainPlant, specification: Specification, nodes: FloatArray) -> list[FloatArray]:
    """Return the controller at which the whole set keeps all constraints, from the nodes that miss them least."""
    looked = nodes[:: max(1, len(nodes) // _LOOKED)]
    least = np.array([np.min(_slacks(plant, specification, node)) for node in looked])
    for node in looked[np.argsort(-least)][:_LED]:

        def missed(p: FloatArray) -> float:
            return -min(float(np.min(_slacks(plant, specification, p))), _INSIDE)

        size = int(np.sum(node > 0.0))
        vertices = 0.3 * (np.vstack((np.zeros(size), np.eye(size))) - 0.5 / size)
        reached, least_missed = search_by_simplex(missed, node, vertices, maxfev=120 * size)
        if least_missed <= 0.0:
            return [reached]
    return []


def _inwards(plant: UncertainPlant, specification: Specification, p: FloatArray) -> FloatArray:
    """Return the controller with as little less gain as the whole set needs; itself where no such gain is found."""
    for factor in np.geomspace(1.0, 0.5, 30):
        lower = p * np.array([factor, 1.0, 1.0, 1.0])
        if np.min(_slacks(plant, specification, lower)) >= 0.0:
            return np.asarray(lower)
    return p


def _quadratic(
    plant: UncertainPlant,
    specification: Specification,
    start: FloatArray,
    spans: Sequence[float],
) -> FloatArray:
    """Return the best controller that sequential quadratic programming in log gains looked at, or else ``start``."""
    free = start > 0.0
    best: tuple[float, FloatArray] = (math.inf, start)

    def look(x: FloatArray) -> tuple[float, FloatArray]:
        nonlocal best
        p = start.copy()
        p[free] = start[free] * np.exp(x)
        norm, slacks = _norm(plant, p), _slacks(plant, specification, p)
        if np.min(slacks) >= 0.0 and norm < best[0]:
            best = (norm, p)
        return norm, slacks - 1e-7

    x = np.zeros(int(np.sum(free)))
    for span in spans:
        minimise(look, x, span, most=40, tolerance=1e-10)
        if best[0] < math.inf:
            x = np.log(best[1][free] / start[free])
    return best[1]


def _least_error(plant: UncertainPlant, specification: Specification, start: FloatArray) -> FloatArray:
    def response(omega: FloatArray) -> ComplexArray:
        log_gain, phase = plant.processes.nominal_log(omega)
        return np.asarray(np.exp(log_gain + 1j * phase))

    n = plant.nominal
    s = 1j * n.omega
    K, Ti, Td, Tf = start
    L = n.h * K * (1.0 + 1.0 / (Ti * s) + Td * s) / (1.0 + Tf * s)
    crossover = float(n.omega[int(np.flatnonzero(np.abs(L) >= 1.0)[-1])])
    load = load_step(response, start, crossover, 1.0 / crossover)
    found = least_error(load, lambda p: _slacks(plant, specification, p) - 1e-6, start)
    return found if np.min(_slacks(plant, specification, found)) >= -1e-6 else start


def _coarse_grid(plant: UncertainPlant, specification: Specification, kind: Kind) -> FloatArray:
    n = plant.nominal
    at = int(np.argmin(np.abs(n.phase + 0.75 * np.pi)))
    omega = float(np.clip(n.omega[at], plant.processes.omega_points[0], plant.processes.omega_points[-1]))
    gain = float(np.interp(omega, n.omega, np.abs(n.h)))
    K = min(specification.largest_gain, 3.0 / gain) * np.geomspace(2e-3, 1.0, 36)
    Ti = np.geomspace(0.1, 100.0, 36) / omega
    if kind == "pi":
        return np.array([(k, t, 0.0, 0.0) for k in K for t in Ti])
    return np.array(
        [
            (k, t, t * share, t * share / ratio)
            for k in K[::2]
            for t in Ti[::2]
            for share in np.geomspace(0.03, 1.5, 8)
            for ratio in (0.7, 1.5, 3.0, 8.0, 20.0)
        ]
    )


def _answer(plant: UncertainPlant, specification: Specification, kind: Kind, p: FloatArray) -> Design:
    from autotune.design.synthesis import weight_set_point

    n = plant.nominal
    K, Ti, Td, Tf = (float(value) for value in p)
    controller = PIDController(K=n.sign * K, Ti_s=Ti, Td_s=Td, Tf_s=Tf)
    kept, gain = guaranteed_figures(plant.omega, plant.supports, K, Ti, Td, Tf, _omega_n(specification))
    modulus = float(kept.modulus)
    L = n.h * controller.response(n.omega) * n.sign
    crossing = int(np.flatnonzero(np.abs(L) >= 1.0)[-1])
    m = Margins(
        stable=True,
        modulus=modulus,
        modulus_frequency_rad_s=float(n.omega[int(np.argmin(np.abs(1.0 + L)))]),
        phase_rad=float(kept.phase_rad),
        delay_s=float(kept.delay_s),
        gain=gain,
        gain_reduction=0.0,
        crossover_rad_s=float(n.omega[crossing]),
        noise_gain=float(kept.noise_gain),
        noise_gain_bound=float(kept.controller_gain) / modulus,
        h2=math.exp(_norm(plant, p)),
    )
    grown = plant.processes.inflation
    remark = (
        f"; {UNCERTAIN} the regions had to be taken {grown:.2f} times as large before any such process passed through"
    )
    remark = f"{remark} them" if grown > 1.0 else ""
    return Design(
        kind=kind,
        controller=weight_set_point(controller, specification),
        specification=specification,
        h2=m.h2,
        h2_lower_bound=None,
        binding=specification.binding(m.figures),
        margins=m,
        certificate=(
            "margins hold for every aperiodic process with dead time, with or without inverse response, through "
            f"the joint {100 * PROBABILITY:g} % region of the {len(plant.processes.omega_points)} points; no lower "
            f"bound on the norm{remark}"
        ),
    )


def _unreachable(plant: UncertainPlant, specification: Specification, kind: Kind, grid: FloatArray) -> DesignError:
    within = [p for p in grid[:: 2 if kind == "pi" else 7] if _slacks(plant, specification, p)[2] >= 0.0]
    share = max((1.0 + float(np.min(_slacks(plant, specification, p)[[0, 1, 3]])) for p in within), default=0.0)
    if share <= 0.0:
        return DesignError(
            "the points do not reach the frequencies where the loop would cross over",
            where="points",
            remedy="measure points with phases between -105 and -160 degrees, and beyond the crossover",
        )
    factor = math.floor(share * 100.0) / 100.0
    return DesignError(
        f"no {kind.upper()} keeps M_m {specification.modulus_margin:g} and "
        f"{math.degrees(specification.phase_margin_rad):g} deg for all plants through the points",
        where="synthesis",
        remedy=f"the nearest that one keeps is M_m {factor * specification.modulus_margin:.3f} and "
        f"{factor * math.degrees(specification.phase_margin_rad):.1f} deg; or measure with smaller regions",
    )
