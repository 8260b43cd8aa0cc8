"""A transfer function from a plain recording: fitted in time, where few frequencies stand out of a step's spectrum.

A recording of bumps and steps carries most of what it knows in a few slow frequencies; points of its spectrum would use
a part of that. Here differential equations with dead time, x^(n) = sum a_i x^(i) + b u(t - h), of orders 1 to 3, with
and without an integrator, are fitted to the whole record by output error (maximum likelihood), and those that the
Bayesian information criterion does not exclude are kept with their covariance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import AutotuneError, IdentificationError
from autotune.identification.delay.identify import identify_delay
from autotune.identification.delay.model import DelayModel
from autotune.identification.parametric import PlantFit, not_excluded
from autotune.models import TransferFunction
from autotune.recording import Recording

_ORDERS = (1, 2, 3)
#: a plant that the data hold for self-regulating stays so in its region: a_0 below this share of its estimate
_LEAST_SHARE = 0.02


@dataclass(frozen=True, kw_only=True)
class _Structure:
    order: int
    integrator: bool


def fit_recordings(recordings: Sequence[Recording]) -> PlantFit:
    """Fit the differential equation with dead time that the recordings determine, with its region.

    Parameters
    ----------
    recordings : sequence of Recording
        Of one plant, with a command that moves; what was measured with feedback needs a delay in the loop.

    Returns
    -------
    PlantFit
        With ``others``, the structures that the data do not exclude. Several recordings of one structure are joined by
        their information; where they contradict each other the covariance grows accordingly.

    Raises
    ------
    IdentificationError
        No structure is determined by the recordings; the reason is that of the simplest.

    Notes
    -----
    Resonances are in the class, zeros are not: inverse response is fitted as dead time and lags.
    """
    models: dict[_Structure, list[DelayModel]] = {}
    reason: AutotuneError | None = None
    for order, integrator in product(_ORDERS, (False, True)):
        structure = _Structure(order=order, integrator=integrator)
        try:
            models[structure] = [identify_delay(one, order, integrator=integrator) for one in recordings]
        except AutotuneError as error:  # the order is more than the record determines
            reason = reason or error
    if not models:
        raise IdentificationError(
            f"no differential equation with dead time is determined: {reason}",
            where=recordings[0].name,
            remedy="record steps of the command, up and down, each until y has settled",
        )
    return not_excluded([_joined(structure, found) for structure, found in models.items()])


def _joined(structure: _Structure, models: Sequence[DelayModel]) -> PlantFit:
    """Return the fit of one structure to all recordings: information adds, and so do the criteria."""
    n = structure.order
    unit = _largest_term(max(models, key=lambda model: model.rows))
    free = [i for i in range(n + 2) if not (structure.integrator and i == 0)]
    forms = [_over(model, unit) for model in models]
    information = [np.linalg.pinv(covariance[np.ix_(free, free)]) for _, covariance in forms]
    covariance = np.linalg.pinv(np.sum(information, axis=0))
    x = forms[0][0].copy()
    x[free] = covariance @ np.sum([J @ v[free] for J, (v, _) in zip(information, forms, strict=True)], axis=0)
    apart = float(sum((v - x)[free] @ J @ (v - x)[free] for J, (v, _) in zip(information, forms, strict=True)))
    freedom = len(free) * (len(models) - 1)
    full = np.zeros((n + 2, n + 2))
    full[np.ix_(free, free)] = covariance * max(1.0, apart / freedom if freedom else 1.0)
    rows = sum(model.rows for model in models)
    lower, upper = _bounds(x, structure)

    def build(parameters: FloatArray) -> TransferFunction:
        *a, b, h = (float(value) for value in parameters)
        den = [-value for value in a]
        den.insert(unit, 1.0)
        return TransferFunction(
            num=(b / den[-1],), den=tuple(value / den[-1] for value in den[::-1]), delay_s=max(0.0, h)
        )

    coefficients = len(free) + 1 + n  # with the constant and the initial state
    return PlantFit(
        plant=build(x),
        integrating=structure.integrator,
        parameters=x,
        covariance=full,
        sign=1 if x[n] > 0.0 else -1,
        chi_square=float(rows - coefficients) + apart,
        degrees_of_freedom=rows - coefficients + freedom,
        bounds=np.stack((lower, upper)),
        build=build,
        criterion=sum(model.rows * 2.0 * math.log(model.noise_sd) for model in models) + coefficients * math.log(rows),
        source="recording",
    )


def _largest_term(model: DelayModel) -> int:
    """Return the power of s whose term is the denominator's largest where the phase is -135 degrees.

    Over its coefficient a slow pole is a rate and a fast one a lag, and what the record determines of them together (a
    fast lag and the dead time as their sum) stays linear in the parameters. In a_0, ..., b it is not: on the border of
    their region a lag of 3 s known to 20 % and a dead time add up to 4 s more than the record allows.
    """
    n = len(model.a)
    plant = model.transfer_function()
    scales = [abs(pole) for pole in plant.poles if pole]
    if model.delay_s > 0.0:
        scales.append(1.0 / model.delay_s)
    if n == 1 or not scales or max(pole.real for pole in plant.poles) > 0.0:
        return n
    omega = np.geomspace(1e-3 * min(scales), 1e3 * max(scales), 1200)
    phase = np.unwrap(np.angle(plant.response(omega)))
    static = -0.5 * math.pi * plant.integrators
    turned = phase - phase[0] + static
    beyond = np.flatnonzero(turned <= -0.75 * math.pi)
    if not beyond.size:
        return n
    terms = np.abs([*model.a, 1.0]) * omega[beyond[0]] ** np.arange(n + 1)
    return int(np.argmax(terms))


def _over(model: DelayModel, unit: int) -> tuple[FloatArray, FloatArray]:
    """Return a_i, -1 for s^n, and b over the coefficient of s^unit, which is left out, h, and their covariance."""
    n = len(model.a)
    values, covariance = model.values[: n + 2], model.covariance[: n + 2, : n + 2]
    if unit == n:
        return values, covariance
    scale = -values[unit]  # the coefficient of s^unit in the denominator
    others = [i for i in range(n) if i != unit]
    x = np.array([*(values[others] / scale), -1.0 / scale, values[n] / scale, values[n + 1]])
    jacobian = np.zeros((n + 2, n + 2))
    for row, i in enumerate([*others, n]):
        jacobian[row if i < n else n, i] = 1.0 / scale
    jacobian[n + 1, n + 1] = 1.0
    jacobian[: n + 1, unit] = x[: n + 1] / scale
    return x, np.asarray(jacobian @ covariance @ jacobian.T, dtype=np.float64)


def _bounds(x: FloatArray, structure: _Structure) -> tuple[FloatArray, FloatArray]:
    """Return bounds of the parameters: a stable plant stays so, a gain keeps its sign, a delay is not negative."""
    n = structure.order
    lower, upper = np.full(n + 2, -np.inf), np.full(n + 2, np.inf)
    for i in range(n):
        if x[i] < 0.0:
            upper[i] = _LEAST_SHARE * x[i]
    (lower if x[n] > 0.0 else upper)[n] = _LEAST_SHARE * x[n]
    lower[n + 1] = 0.0
    return lower, upper
