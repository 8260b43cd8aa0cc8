"""A transfer function from a plain recording: fitted in time, where few frequencies stand out of a step's spectrum.

A recording of bumps and steps carries most of what it knows in a few slow frequencies; points of its spectrum would use
a part of that. Here differential equations with dead time, x^(n) = sum a_i x^(i) + b u(t - h), of orders 1 to 3, with
and without an integrator, are fitted to the whole record by output error (maximum likelihood), and those that the
Bayesian information criterion does not exclude are kept with their covariance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count, product

import numpy as np
from scipy.optimize import minimize_scalar

from autotune.arrays import FloatArray
from autotune.distributions import chi2_tail
from autotune.errors import AutotuneError, IdentificationError
from autotune.identification.answer import is_fed_back
from autotune.identification.delay.identify import identify_delay
from autotune.identification.delay.model import DelayModel
from autotune.identification.equation_region import LEAST_SHARE, Equation, join_fits, largest_term
from autotune.identification.lines import is_one_sine
from autotune.identification.parametric import EXCLUDED, PlantFit, not_excluded
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint
from autotune.progress import Progress, quiet
from autotune.recording import Recording

_ORDERS = (1, 2, 3)
#: a zero is looked for on each side where so small a part of the lags' sum as its time constant already fits better
_FIRST_ZERO = 0.1
_ZEROS = (0.25, 0.5, 1.0, 2.0)
_ZERO_STEPS = 12
#: Rows of y among which structures are chosen: what so many exclude is excluded by all.
_CHOSEN_ON = 20_000
#: probability of what points of the same plant are off a fit, below which they contradict it; draws of the fit for it
_CONTRADICTED, _DRAWS = 1e-4, 200


@dataclass(frozen=True, kw_only=True)
class _Structure:
    order: int
    integrator: bool


@dataclass(frozen=True, kw_only=True)
class _Fitted:
    """One structure fitted to every recording, for a zero at s = -1/tau, tau = 0 where there is none."""

    structure: _Structure
    models: tuple[DelayModel, ...]
    tau_s: float = 0.0
    thinned: bool = True  # whether long recordings were fitted to some of their rows

    @property
    def coefficients(self) -> int:
        """How many there are, with the constant and the initial state of each recording."""
        each = 1 + self.structure.order
        return self.structure.order + 2 - self.structure.integrator + (self.tau_s != 0.0) + each * len(self.models)

    def criterion(self, rows: Sequence[int]) -> float:
        """Return the Bayesian criterion if each recording had so many rows: what a delay leaves out differs."""
        likelihood = sum(n * 2.0 * math.log(model.noise_sd) for n, model in zip(rows, self.models, strict=True))
        return likelihood + self.coefficients * math.log(sum(rows))


def fit_recordings(
    recordings: Sequence[Recording], progress: Progress = quiet, unbiased: Sequence[FrequencyPoint] = ()
) -> PlantFit:
    """Fit the differential equation with dead time that the recordings determine, with its region.

    Parameters
    ----------
    recordings : sequence of Recording
        Of one plant, with a command that moves; what was measured with feedback needs a delay in the loop.
    progress : Progress
        Told which structure is being fitted.
    unbiased : sequence of FrequencyPoint
        Of the same plant, of a kind that feedback does not bias: a structure that they contradict is left out.

    Returns
    -------
    PlantFit
        With ``others``, the structures that the data do not exclude. Several recordings of one structure are joined by
        their information; where they contradict each other the covariance grows accordingly.

    Raises
    ------
    IdentificationError
        No structure is determined by the recordings, as by a single sine; the reason is that of the simplest. Or points
        contradict all.

    Notes
    -----
    Of long records one row in so many chooses among the structures, and all rows are fitted with those that remain.
    Resonances are in the class, and in open loop one zero of a plant of order 2 (inverse response, overshoot); under
    feedback a zero would take up what the noise model leaves of the load that the controller answers. There the inverse
    of the controller, delayed, may fit best as well, as what the noise does comes back by it.
    """
    if len(recordings) == 1 and is_one_sine(recordings[0].u):
        raise IdentificationError(
            "u is one sine: it tells gain and phase at its frequency, and a plant has a gain, a lag and a dead time",
            where=recordings[0].name,
            remedy="record sines of two frequencies or more, or steps",
        )
    fits = _agreeing(recordings, _every_structure(recordings, progress), unbiased)
    if any(_one_in(one) > 1 for one in recordings):
        progress("fitting all rows", 0.9)
        least = min(fit.criterion for _, fit in fits)
        kept = [one for one, fit in fits if fit.criterion - least < EXCLUDED]
        fits = _agreeing(recordings, _on_all_rows(recordings, kept), unbiased)
    return not_excluded([fit for _, fit in fits])


def _one_in(recording: Recording) -> int:
    """Return in how many rows one is fitted to choose: a prime, to meet rows at all distances from regular steps."""
    return next(k for k in count(max(1, len(recording) // _CHOSEN_ON)) if all(k % d for d in range(2, k)))


def _every_structure(recordings: Sequence[Recording], progress: Progress) -> list[_Fitted]:
    """Return the structures that some of the rows determine, those with a zero besides."""
    found: list[_Fitted] = []
    reason: AutotuneError | None = None
    kinds = list(product(_ORDERS, (False, True)))
    for i, (order, integrator) in enumerate(kinds):
        progress(f"fitting order {order}{', integrating' if integrator else ''}", i / (len(kinds) + 1))
        structure = _Structure(order=order, integrator=integrator)
        try:
            models = tuple(identify_delay(one, order, integrator=integrator, every=_one_in(one)) for one in recordings)
        except AutotuneError as error:  # the order is more than the record determines
            reason = reason or error
            continue
        found.append(_Fitted(structure=structure, models=models))
    if not found:
        raise IdentificationError(
            f"no differential equation with dead time is determined: {reason}",
            where=recordings[0].name,
            remedy="record steps of the command, up and down, each until y has settled",
        )
    progress("looking for a zero", len(kinds) / (len(kinds) + 1))
    if not any(is_fed_back(one) for one in recordings):
        found += [zero for one in found if one.structure.order == 2 and (zero := _zero(recordings, one)) is not None]
    return found


def _on_all_rows(recordings: Sequence[Recording], kept: Sequence[_Fitted]) -> list[_Fitted]:
    """Return structures that were chosen on some of the rows, fitted to all of them from where they are."""
    found: list[_Fitted] = []
    for structure in {one.structure: None for one in kept}:
        alike = [one for one in kept if one.structure == structure]
        without = _at_zero(recordings, replace(alike[0], thinned=False), 0.0)
        if without is not None:
            found.append(without)
            zero = _zero(recordings, without) if any(one.tau_s for one in alike) else None
            found += [] if zero is None else [zero]
    return found or list(kept)


def _agreeing(
    recordings: Sequence[Recording], found: Sequence[_Fitted], unbiased: Sequence[FrequencyPoint]
) -> list[tuple[_Fitted, PlantFit]]:
    """Return structures with their regions, but for those that points contradict; IdentificationError without any."""
    rows = [min(one.models[i].rows for one in found) for i in range(len(recordings))]
    fits = [(one, _with_zero(recordings, one, rows) if one.tau_s else _join(one, rows)) for one in found]
    agreeing = [(one, fit) for one, fit in fits if _agrees(fit, unbiased)]
    if not agreeing:
        raise IdentificationError(
            "what y does after u is not what it does after the set-point, with any structure",
            where=recordings[0].name,
            remedy="move the set-point more, or record the plant with the controller off",
        )
    return agreeing


def _agrees(fit: PlantFit, points: Sequence[FrequencyPoint]) -> bool:
    """Whether points do not contradict a fit, by the covariance of both (Hausman's test, with the two independent)."""
    if not points:
        return True
    omega = np.array([point.omega_rad_s for point in points])
    drawn = np.array([plant.response(omega) for plant in fit.draws(_DRAWS, np.random.default_rng(0))])
    errors = np.array([point.response for point in points]) - fit.plant.response(omega)
    distance = 0.0
    for point, error, of_fit in zip(points, errors, drawn.T, strict=True):
        e = np.array([error.real, error.imag])
        distance += float(e @ np.linalg.solve(np.array(point.covariance) + np.cov([of_fit.real, of_fit.imag]), e))
    return chi2_tail(distance, 2 * len(points)) >= _CONTRADICTED


def _leading(recording: Recording, tau_s: float) -> Recording:
    """Return the recording with the command (1 + tau s) u: a jump of u acts once more, over the rows around it."""
    return replace(recording, u=recording.u + tau_s * np.gradient(recording.u, recording.t))


def _at_zero(recordings: Sequence[Recording], near: _Fitted, tau_s: float) -> _Fitted | None:
    """Return the fit with this zero that lies near another; None where it is not determined."""
    n, integrator = near.structure.order, near.structure.integrator
    try:
        models = tuple(
            identify_delay(
                _leading(one, tau_s), n, integrator=integrator, start=model, every=_one_in(one) if near.thinned else 1
            )
            for one, model in zip(recordings, near.models, strict=True)
        )
    except AutotuneError:
        return None
    return replace(near, models=models, tau_s=tau_s)


def _zero(recordings: Sequence[Recording], without: _Fitted) -> _Fitted | None:
    """Return the structure with the zero that fits best; None where none fits better than no zero at all."""
    rows = [model.rows for model in without.models]
    model = max(without.models, key=lambda one: one.rows)
    scale = sum(1.0 / abs(pole) for pole in model.poles if pole) + model.delay_s
    least, best = without.criterion(rows), without
    for side in (-scale, scale):
        near = without
        for share in (_FIRST_ZERO, *_ZEROS):
            at = _at_zero(recordings, near, share * side)
            if at is None or at.criterion(rows) > near.criterion(rows) + EXCLUDED:
                break
            near = at
            if at.criterion(rows) < least:
                least, best = at.criterion(rows), at
    if best is without:
        return None
    tried: list[tuple[float, _Fitted]] = [(least, best)]
    refused = without.criterion(rows) + EXCLUDED  # finite: the search draws parabolas through what it is told

    def cost(tau_s: float) -> float:
        one = _at_zero(recordings, best, tau_s)
        tried.append((refused if one is None else one.criterion(rows), one or best))
        return tried[-1][0]

    low, high = sorted((0.4 * best.tau_s, 1.8 * best.tau_s))
    near_s = 0.01 * abs(best.tau_s)
    minimize_scalar(cost, bounds=(low, high), method="bounded", options={"maxiter": _ZERO_STEPS, "xatol": near_s})
    return min(tried, key=lambda pair: pair[0])[1]


def _with_zero(recordings: Sequence[Recording], found: _Fitted, rows: Sequence[int]) -> PlantFit:
    """Return the fit with tau among its parameters; its variance is the curvature of what is left beside it."""
    unit = largest_term(max(found.models, key=lambda model: model.rows).transfer_function())
    middle = _join(found, rows, unit)
    way = 0.1 * found.tau_s
    slope, variance = np.zeros(middle.parameters.size), (0.5 * found.tau_s) ** 2
    for _ in range(2):
        beside = [_at_zero(recordings, found, found.tau_s + step) for step in (-way, way)]
        if beside[0] is None or beside[1] is None:
            break
        low, high = (_join(one, rows, unit) for one in beside if one is not None)
        curvature = (low.criterion + high.criterion - 2.0 * middle.criterion) / way**2
        slope = (high.parameters - low.parameters) / (2.0 * way)
        variance = min(2.0 / curvature if curvature > 0.0 else math.inf, (0.5 * found.tau_s) ** 2)
        way = 2.0 * math.sqrt(variance)
    along = np.append(slope, 1.0)
    covariance = variance * np.outer(along, along)
    covariance[:-1, :-1] += middle.covariance
    ends = found.tau_s * np.array([LEAST_SHARE, 2.0])

    def build(parameters: FloatArray) -> TransferFunction:
        plant = middle.build(parameters[:-1])
        return replace(plant, num=(float(parameters[-1]) * plant.num[0], plant.num[0]))

    x = np.append(middle.parameters, found.tau_s)
    return replace(
        middle,
        plant=build(x),
        parameters=x,
        covariance=covariance,
        bounds=np.column_stack((middle.bounds, np.sort(ends))),
        build=build,
    )


def _join(found: _Fitted, common: Sequence[int], unit: int | None = None) -> PlantFit:
    """Return the fit of one structure to all recordings."""
    equations = [Equation.of(model, found.structure.integrator) for model in found.models]
    return join_fits(equations, unit, found.coefficients, found.criterion(common))
