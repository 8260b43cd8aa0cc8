"""Differential equations with dead time fitted to all rows of a sweep, begun at the points of its limit cycles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import IdentificationError
from autotune.identification.delay.data import DelayData
from autotune.identification.delay.output_error import Point, Structure, minimise, solve_linear
from autotune.identification.delay.output_error_model import inverse_information
from autotune.identification.equation_region import Equation
from autotune.identification.noise_filter import Whitening
from autotune.points import FrequencyPoint

_ORDERS, _ZEROS = (1, 2, 3, 4), (0, 1)
#: dead times, of the longest, from which an equation through the cycles' points is begun
_SHARES = np.linspace(0.0, 1.0, 25) ** 1.5
#: of each structure so many dead times are tried on the rows
_TRIED = 4
#: times that the equation's error is weighted anew with the denominator before
_REWEIGHTED = 4
#: rows by which a delay is moved to leave a local minimum, and variances by which the next one has to be lower
_STRIDE, _LOWER = 1.5, 1e-3
_ITERATIONS = 40


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """One structure at its minimum.

    Attributes
    ----------
    structure, point
        What was fitted, and where its minimum lies.
    covariance : (n + m + 2, n + m + 2) array
        Of a_0..a_(n-1), b_0..b_m, h; zero rows for what is known.
    places : int
        From how many the search could begin.
    """

    structure: Structure
    point: Point
    covariance: FloatArray
    places: int

    @property
    def criterion(self) -> float:
        """Akaike's, which keeps a pole that the rows only just show, whose lack would bias every point.

        The best of so many places fits noise better by twice their logarithm: poles that ring are looked for in many.
        """
        paid = 2.0 * self.structure.parameters + 2.0 * math.log(self.places)
        return self.point.rows * math.log(self.point.cost / self.point.rows) + paid

    @property
    def equation(self) -> Equation:
        """The equation."""
        n, point = self.structure.order, self.point
        return Equation(
            order=n,
            integrator=self.structure.integrator,
            values=np.array([*point.a, point.theta[0], *point.theta[2 + n :], point.h]),
            covariance=self.covariance,
            noise_sd=math.sqrt(point.cost / (point.rows - self.structure.parameters)),
            rows=point.rows,
        )

    def response(self, omega_rad_s: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Return the response (W,) and, to first order, the covariance of its (real, imaginary) parts, (2W, 2W)."""
        n, values, s = self.structure.order, self.equation.values, 1j * omega_rad_s
        powers = s[None, :] ** np.arange(n + 1)[:, None]
        denominator = powers[n] - values[:n] @ powers[:n]
        late = np.exp(-s * values[-1])
        of_u = powers[: values.size - n - 1] * late / denominator
        G = values[n:-1] @ of_u
        slopes = np.vstack([G * powers[:n] / denominator, of_u, (-s * G)[None, :]])
        parts = as_parts(slopes)
        covariance = parts.T @ self.covariance @ parts
        return np.asarray(G, dtype=np.complex128), np.asarray(covariance, dtype=np.float64)


def fit_from_points(points: Sequence[FrequencyPoint], data: DelayData, largest: float) -> list[Fitted]:
    """Return every structure at its minimum that the rows determine, under white noise.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        Of the sweep's cycles.
    data : DelayData
        Its rows.
    largest : float
        Longest delay [s].

    Raises
    ------
    IdentificationError
        The rows determine none.

    Notes
    -----
    A structure begins at the equations through the points, or where smaller ones ended: with a zero more, a lag, or two
    poles that ring, of whose places the rows take theirs.
    """
    omega = np.array([point.omega_rad_s for point in points])
    G = np.array([point.response for point in points])
    found: list[Fitted] = []
    for n, zeros, integrator in product(_ORDERS, _ZEROS, (True, False)):
        structure = Structure(order=n, integrator=integrator, zeros=zeros)
        if zeros >= n or n + 1 - integrator + zeros > 2 * len(points):
            continue
        through = sorted((*_through(omega, G, structure, h), h) for h in largest * _SHARES)
        places = [(a, h) for _, a, h in through[:_TRIED]]
        places += [place for one in found for place in _grow_places(one, structure, omega)]
        begun = min((solve_linear(data, structure, *place) for place in places), key=lambda point: point.cost)
        found += _fit_structure(data, structure, begun, len(places), largest, Whitening())
    return _drop_undetermined(found, data)


def _grow_places(one: Fitted, structure: Structure, omega: FloatArray) -> list[tuple[tuple[float, ...], float]]:
    """Return places (a, h) of a structure that a smaller one's minimum leads to; none where it is no step away."""
    more = structure.order - one.structure.order
    if one.structure.integrator != structure.integrator or structure.zeros - one.structure.zeros != (more == 0):
        return []
    if more == 0:
        return [(one.point.a, share * one.point.h) for share in (0.3, 0.6, 1.0)]
    high, low = float(omega.max()), float(omega.min())
    factors = [[1.0, w] for w in (high, 3.0 * high)] if more == 1 else []
    if more == 2:
        factors = [[1.0, 2.0 * d * w, w * w] for w in np.geomspace(low, 8.0 * high, 10) for d in (0.05, 0.3)]
    den = np.array([1.0, *(-value for value in one.point.a[::-1])])
    made = [np.polymul(den, factor) for factor in factors]
    return [(tuple((-each[:0:-1]).tolist()), share * one.point.h) for each in made for share in (0.5, 1.0)]


def _through(omega: FloatArray, G: ComplexArray, structure: Structure, h: float) -> tuple[float, tuple[float, ...]]:
    """Return how far an equation with a dead time misses points, relative, and its a_0..a_(n-1)."""
    n, scale = structure.order, float(np.exp(np.mean(np.log(omega))))
    s = 1j * omega / scale
    first = 1 if structure.integrator else 0
    powers = s[None, :] ** np.arange(n + 1)[:, None]
    late = powers[: structure.zeros + 1] * np.exp(-1j * omega * h)
    columns = np.vstack([powers[first:n] * G, late])
    denominator, x = np.ones_like(s), np.empty(0)
    for _ in range(_REWEIGHTED):
        weight = 1.0 / (np.abs(denominator) * np.abs(G))
        sides = as_parts(np.asarray(np.vstack([columns, powers[n] * G]) * weight, dtype=np.complex128))
        x = np.linalg.lstsq(sides[:-1].T, sides[-1], rcond=None)[0]
        denominator = powers[n] - x[: n - first] @ powers[first:n]
    missed = x[n - first :] @ late / denominator / G - 1.0
    a = np.concatenate([np.zeros(first), x[: n - first]]) * scale ** np.arange(n, 0, -1)
    return float(np.sum(np.abs(missed) ** 2)), tuple(a.tolist())


def fit_again(data: DelayData, found: Sequence[Fitted], largest: float, whitening: Whitening) -> list[Fitted]:
    """Return structures at their minima under noise of another colour.

    Parameters
    ----------
    data : DelayData
        The sweep's rows.
    found : sequence of Fitted
        Where each begins.
    largest : float
        Longest delay [s].
    whitening : Whitening
        Makes the noise white.

    Raises
    ------
    IdentificationError
        The rows determine none.
    """
    again: list[Fitted] = []
    for one in found:
        begun = solve_linear(data, one.structure, one.point.a, one.point.h, whitening)
        again += _fit_structure(data, one.structure, begun, one.places, largest, whitening)
    return _drop_undetermined(again, data)


def _drop_undetermined(found: list[Fitted], data: DelayData) -> list[Fitted]:
    if not found:
        raise IdentificationError("no equation is determined by the rows of the sweep", where=data.name)
    return found


def _fit_structure(
    data: DelayData, structure: Structure, begun: Point, places: int, largest: float, whitening: Whitening
) -> list[Fitted]:
    """Return a structure at its minimum; nothing where the rows do not determine it."""
    if not math.isfinite(begun.cost):
        return []
    at = _lowest(data, structure, begun, largest, whitening)
    covariance = _covariance(data, structure, at, whitening)
    return [] if covariance is None else [Fitted(structure=structure, point=at, covariance=covariance, places=places)]


def _lowest(data: DelayData, structure: Structure, start: Point, largest: float, whitening: Whitening) -> Point:
    """Return the lowest minimum around a start: over h there is one beyond each row that a step of u passes."""
    best = minimise(data, structure, start, max_delay_s=largest, whitening=whitening, iterations=_ITERATIONS)
    step_s = float(np.median(np.diff(data.tu)))
    for rows in (1.0, -1.0):
        at = best
        room_s = largest - best.h if rows > 0.0 else best.h
        for _ in range(1 + math.ceil(room_s / (_STRIDE * step_s))):  # on, as long as it goes down and there are rows
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


def _covariance(data: DelayData, structure: Structure, at: Point, whitening: Whitening) -> FloatArray | None:
    """Return the covariance of a_0.., b_0.., h at a minimum; None where the rows do not determine them."""
    inverse = inverse_information(data, structure, at, whitening)
    if inverse is None:
        return None
    n = structure.order
    linear = structure.linear.size
    wanted = [*range(linear, linear + n), 0, *range(2 + n, linear), linear + n]
    variance = at.cost / (at.rows - structure.parameters)
    return np.asarray(variance * inverse[np.ix_(wanted, wanted)])


def as_parts(values: ComplexArray) -> FloatArray:
    """Return real and imaginary parts, each pair beside each other in the last axis."""
    return np.stack([values.real, values.imag], axis=-1).reshape(*values.shape[:-1], -1)
