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
    free = [i for i in range(n + 2) if not (structure.integrator and i == 0)]
    values = [model.values[: n + 2] for model in models]
    information = [np.linalg.pinv(model.covariance[np.ix_(free, free)]) for model in models]
    covariance = np.linalg.pinv(np.sum(information, axis=0))
    x = values[0].copy()
    x[free] = covariance @ np.sum([J @ v[free] for J, v in zip(information, values, strict=True)], axis=0)
    apart = float(sum((v - x)[free] @ J @ (v - x)[free] for J, v in zip(information, values, strict=True)))
    freedom = len(free) * (len(models) - 1)
    full = np.zeros((n + 2, n + 2))
    full[np.ix_(free, free)] = covariance * max(1.0, apart / freedom if freedom else 1.0)
    rows = sum(model.rows for model in models)
    lower, upper = _bounds(x, structure)

    def build(parameters: FloatArray) -> TransferFunction:
        *a, b, h = (float(value) for value in parameters)
        return TransferFunction(num=(b,), den=(1.0, *(-value for value in a[::-1])), delay_s=max(0.0, h))

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


def _bounds(x: FloatArray, structure: _Structure) -> tuple[FloatArray, FloatArray]:
    """Return bounds of (a_0, ..., b, h): a stable plant stays so, a gain keeps its sign, a delay is not negative."""
    n = structure.order
    lower, upper = np.full(n + 2, -np.inf), np.full(n + 2, np.inf)
    for i in range(n):
        if x[i] < 0.0:
            upper[i] = _LEAST_SHARE * x[i]
    (lower if x[n] > 0.0 else upper)[n] = _LEAST_SHARE * x[n]
    lower[n + 1] = 0.0
    return lower, upper
