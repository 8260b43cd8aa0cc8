"""The region of a plant to which differential equations with dead time were fitted, from one recording or several."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray, inverse_in_any_units
from autotune.identification.delay.model import DelayModel
from autotune.identification.parametric import PlantFit, not_excluded
from autotune.models import TransferFunction

#: a plant that the data hold for self-regulating stays so in its region: a_0 below this share of its estimate
LEAST_SHARE = 0.02


@dataclass(frozen=True, kw_only=True, eq=False)
class Equation:
    """x^(n) = sum a_i x^(i) + b_0 u(t - h) + b_1 u'(t - h) + .., fitted to one recording.

    Attributes
    ----------
    order : int
        n.
    integrator : bool
        Whether a_0 = 0 is known.
    values : (n + m + 2,) array
        a_0..a_(n-1), b_0..b_m, h [s].
    covariance : (n + m + 2, n + m + 2) array
        Of them; zero rows for what is known.
    noise_sd : float
        Standard deviation of what is left, of its innovation where it is coloured [y unit].
    rows : int
        Rows of y that were used.
    """

    order: int
    integrator: bool
    values: FloatArray
    covariance: FloatArray
    noise_sd: float
    rows: int

    @staticmethod
    def of(model: DelayModel, integrator: bool) -> Equation:
        """Return a model's equation, which has no zeros.

        Parameters
        ----------
        model : DelayModel
            The model.
        integrator : bool
            Whether its a_0 = 0 was known.
        """
        size = model.order + 2
        return Equation(
            order=model.order,
            integrator=integrator,
            values=model.values[:size],
            covariance=model.covariance[:size, :size],
            noise_sd=model.noise_sd,
            rows=model.rows,
        )

    @property
    def plant(self) -> TransferFunction:
        """(b_0 + b_1 s + ..) exp(-s h) / (s^n - a_(n-1) s^(n-1) - .. - a_0)."""
        return _plant_over(self.values, self.order, self.order)

    @property
    def unknown(self) -> int:
        """How many numbers were fitted, a constant and the initial state among them."""
        return self.values.size - self.integrator + 1 + self.order


def plant_fit(equations: Sequence[Equation]) -> PlantFit:
    """Return the fit of one recording's equations that its rows do not exclude."""
    rows = min(one.rows for one in equations)
    return not_excluded(
        [
            join_fits([one], None, one.unknown, rows * 2.0 * math.log(one.noise_sd) + one.unknown * math.log(rows))
            for one in equations
        ]
    )


def join_fits(equations: Sequence[Equation], unit: int | None, coefficients: int, criterion: float) -> PlantFit:
    """Return the fit of one structure to all recordings: information adds, and so do the criteria.

    Parameters
    ----------
    equations : sequence of Equation
        One for each recording, of the same order and zeros.
    unit : int, optional
        Power of s whose coefficient the others are divided by; that of the largest term where absent.
    coefficients : int
        How many numbers were fitted to all of the recordings.
    criterion : float
        What the fit is compared by.
    """
    n, size, integrator = equations[0].order, equations[0].values.size, equations[0].integrator
    unit = largest_term(max(equations, key=lambda one: one.rows).plant) if unit is None else unit
    free = [i for i in range(size) if not (integrator and i == 0)]
    forms = [_over(one, unit) for one in equations]
    information = [inverse_in_any_units(covariance[np.ix_(free, free)]) for _, covariance in forms]
    covariance = inverse_in_any_units(np.sum(information, axis=0))
    x = forms[0][0].copy()
    x[free] = covariance @ np.sum([J @ v[free] for J, (v, _) in zip(information, forms, strict=True)], axis=0)
    apart = float(sum((v - x)[free] @ J @ (v - x)[free] for J, (v, _) in zip(information, forms, strict=True)))
    freedom = len(free) * (len(equations) - 1)
    full = np.zeros((size, size))
    full[np.ix_(free, free)] = covariance * max(1.0, apart / freedom if freedom else 1.0)
    rows = sum(one.rows for one in equations)

    def build(parameters: FloatArray) -> TransferFunction:
        return _plant_over(parameters, n, unit)

    return PlantFit(
        plant=build(x),
        integrating=integrator,
        parameters=x,
        covariance=full,
        sign=1 if x[n] > 0.0 else -1,
        chi_square=float(rows - coefficients) + apart,
        degrees_of_freedom=rows - coefficients + freedom,
        bounds=np.stack(_bounds(x, n)),
        build=build,
        criterion=criterion + apart,
        source="recording",
    )


def _plant_over(parameters: FloatArray, n: int, unit: int) -> TransferFunction:
    """Return the plant of a_0.., b_0.., h over the coefficient of s^unit, as of :func:`_over`."""
    *numbers, h = (float(value) for value in parameters)
    den = [-value for value in numbers[:n]]
    den.insert(unit, 1.0)
    return TransferFunction(
        num=tuple(value / den[-1] for value in numbers[: n - 1 : -1]),
        den=tuple(value / den[-1] for value in den[::-1]),
        delay_s=max(0.0, h),
    )


def largest_term(plant: TransferFunction) -> int:
    """Return the power of s whose term is the denominator's largest where the phase is -135 degrees.

    Over its coefficient a slow pole is a rate and a fast one a lag, and what the record determines of them together (a
    fast lag and the dead time as their sum) stays linear in the parameters. In a_0, ..., b it is not: on the border of
    their region a lag of 3 s known to 20 % and a dead time add up to 4 s more than the record allows.
    """
    n, poles = len(plant.den) - 1, np.roots(plant.den)
    scales = [abs(pole) for pole in poles if pole]
    if plant.delay_s > 0.0:
        scales.append(1.0 / plant.delay_s)
    if n == 1 or not scales or max(pole.real for pole in poles) > 0.0:
        return n
    omega = np.geomspace(1e-3 * min(scales), 1e3 * max(scales), 1200)
    phase = np.unwrap(np.angle(plant.response(omega)))
    static = -0.5 * math.pi * plant.integrators
    turned = phase - phase[0] + static
    beyond = np.flatnonzero(turned <= -0.75 * math.pi)
    if not beyond.size:
        return n
    return int(np.argmax(np.abs(plant.den[::-1]) * omega[beyond[0]] ** np.arange(n + 1)))


def _over(one: Equation, unit: int) -> tuple[FloatArray, FloatArray]:
    """Return a_i, -1 for s^n, and b_j over the coefficient of s^unit, which is left out, h, and their covariance."""
    n, values, size = one.order, one.values, one.values.size
    if unit == n:
        return values, one.covariance
    scale = -values[unit]  # the coefficient of s^unit in the denominator
    others = [i for i in range(n) if i != unit]
    x = np.array([*(values[others] / scale), -1.0 / scale, *(values[n:-1] / scale), values[-1]])
    jacobian = np.zeros((size, size))
    for row, i in enumerate(others):
        jacobian[row, i] = 1.0 / scale
    for i in range(n, size - 1):
        jacobian[i, i] = 1.0 / scale
    jacobian[-1, -1] = 1.0
    jacobian[:-1, unit] = x[:-1] / scale
    return x, np.asarray(jacobian @ one.covariance @ jacobian.T, dtype=np.float64)


def _bounds(x: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Return bounds of the parameters: a stable plant stays so, a gain keeps its sign, a delay is not negative."""
    lower, upper = np.full(x.size, -np.inf), np.full(x.size, np.inf)
    for i in range(n):
        if x[i] < 0.0:
            upper[i] = LEAST_SHARE * x[i]
    (lower if x[n] > 0.0 else upper)[n] = LEAST_SHARE * x[n]
    lower[-1] = 0.0
    return lower, upper
