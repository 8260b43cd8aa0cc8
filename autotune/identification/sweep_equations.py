"""Differential equations with dead time fitted to all rows of a sweep, begun at the points of its limit cycles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import AutotuneError, IdentificationError
from autotune.identification.delay.data import DelayData
from autotune.identification.delay.model import DelayModel
from autotune.identification.delay.output_error import Point, Structure, minimise, solve_linear
from autotune.identification.delay.output_error_model import finish
from autotune.identification.parametric import fit_structures
from autotune.points import FrequencyPoint

_ORDERS = (1, 2, 3)
#: rows by which a delay is moved to leave a local minimum, and variances by which the next one has to be lower
_STRIDE, _LOWER = 1.5, 1e-3
_ITERATIONS = 40
#: of the slowest limit cycle's frequency: a pole there looks like an integrator's in all limit cycles
_SLOW = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """One structure at its minimum."""

    structure: Structure
    point: Point
    model: DelayModel

    @property
    def criterion(self) -> float:
        """Akaike's: it keeps a pole that the rows only just show, whose lack would bias every point."""
        return self.point.rows * math.log(self.point.cost / self.point.rows) + 2.0 * self.structure.parameters

    def response(self, omega_rad_s: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Return the response (W,) and, to first order, the covariance of its (real, imaginary) parts, (2W, 2W)."""
        model, n, s = self.model, self.model.order, 1j * omega_rad_s
        powers = s[None, :] ** np.arange(n)[:, None]
        denominator = s**n - np.array(model.a) @ powers
        G = model.b * np.exp(-s * model.delay_s) / denominator
        slopes = np.vstack([G * powers / denominator, (G / model.b)[None, :], (-s * G)[None, :]])
        parts = as_parts(slopes)
        covariance = parts.T @ model.covariance[: n + 2, : n + 2] @ parts
        return np.asarray(G, dtype=np.complex128), np.asarray(covariance, dtype=np.float64)


def starts_of(points: Sequence[FrequencyPoint], data: DelayData, largest: float) -> list[tuple[Structure, Point]]:
    """Return a start for each structure: lags and dead time through the cycles' own points.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        Of the sweep's cycles.
    data : DelayData
        Its rows.
    largest : float
        Longest delay [s].
    """
    fits = fit_structures(points)
    slowest = min(point.omega_rad_s for point in points)
    found: list[tuple[Structure, Point]] = []
    for n, integrator in product(_ORDERS, (True, False)):
        structure = Structure(order=n, integrator=integrator)
        near = next((f for f in fits if f.integrating == integrator and len(f.plant.den) == n + 1), None)
        if near is not None:
            a = tuple(-value / near.plant.den[0] for value in near.plant.den[:0:-1])
            h = near.plant.delay_s
        else:  # of three lags: an integrator and two, leaking
            integrating = found[-1][1]
            a, h = (integrating.a[1] * _SLOW * slowest, *integrating.a[1:]), integrating.h
        found.append((structure, solve_linear(data, structure, a, min(h, largest))))
    return found


def fit_all(
    data: DelayData, starts: Sequence[tuple[Structure, Point]], largest: float, whitening: FloatArray
) -> list[Fitted]:
    """Return every structure at its minimum that the rows determine.

    Parameters
    ----------
    data : DelayData
        The sweep's rows.
    starts : sequence of (Structure, Point)
        Where each begins.
    largest : float
        Longest delay [s].
    whitening : (p,) array
        Coefficients of the filter that makes the noise white.

    Raises
    ------
    IdentificationError
        The rows determine none.
    """
    found: list[Fitted] = []
    for structure, start in starts:
        at = solve_linear(data, structure, start.a, start.h, whitening)
        if not math.isfinite(at.cost):
            continue
        at = _lowest(data, structure, at, largest, whitening)
        try:
            found.append(Fitted(structure=structure, point=at, model=finish(data, structure, at, whitening)))
        except AutotuneError:  # more than the rows determine
            continue
    if not found:
        raise IdentificationError("no equation is determined by the rows of the sweep", where=data.name)
    return found


def _lowest(data: DelayData, structure: Structure, start: Point, largest: float, whitening: FloatArray) -> Point:
    """Return the lowest minimum around a start: over h there is one beyond each row that a step of u passes."""
    best = minimise(data, structure, start, max_delay_s=largest, whitening=whitening, iterations=_ITERATIONS)
    step_s = float(np.median(np.diff(data.tu)))
    for rows in (1.0, -1.0):
        at = best
        while True:  # on, as long as it goes down
            h = at.h + rows * _STRIDE * step_s
            beside = solve_linear(data, structure, at.a, min(max(h, 0.0), largest), whitening)
            if not math.isfinite(beside.cost):
                break
            beside = minimise(data, structure, beside, max_delay_s=largest, whitening=whitening, iterations=_ITERATIONS)
            if beside.cost > at.cost - _LOWER * at.variance:
                break
            at = beside
        best = min(best, at, key=lambda one: one.cost)
    return best


def as_parts(values: ComplexArray) -> FloatArray:
    """Return real and imaginary parts, each pair beside each other in the last axis."""
    return np.stack([values.real, values.imag], axis=-1).reshape(*values.shape[:-1], -1)
