"""Points of a relay sweep from all its rows together: one differential equation with dead time, and a test of it.

A point of its own uses the rows of one limit cycle. Where the plant is a differential equation of low order with dead
time, every row of the sweep, transients included, tells of every point, and a third of the time suffices. Equations of
orders 1 to 3, with and without an integrator, are fitted by output error; each weighs by Akaike's criterion, and how
far they differ counts in the points' covariance. Whether any of it may be used, the rows say: what the best equation
leaves must not grow smaller, by more than noise does, where every limit cycle gets a fundamental, harmonics, an offset
and a drift of its own.

References
----------
Buckland, Burnham, Augustin, Model selection: an integral part of inference, Biometrics 53, 1997 (weights).
Breusch, Pagan, The Lagrange multiplier test and its applications, Review of Economic Studies 47, 1980 (the test).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.distributions import chi2_quantile
from autotune.identification.delay.data import prepare
from autotune.identification.envelope import polar_sd
from autotune.identification.equation_region import plant_fit
from autotune.identification.frequency.limit_cycle import WholePeriods
from autotune.identification.noise_filter import Whitening
from autotune.identification.parametric import PlantFit
from autotune.identification.sweep_adequacy import TESTS, colour_beside, judge_equation, own_columns
from autotune.identification.sweep_equations import Fitted, as_parts, fit_again, fit_from_points
from autotune.points import FrequencyPoint, as_pairs
from autotune.recording import Recording

Cycle: TypeAlias = tuple[FrequencyPoint, WholePeriods]

#: probability with which the tests of a sweep send a right equation away, however often its rows are looked at
LEVEL = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class SweepEstimate:
    """What all rows of a sweep say together.

    Attributes
    ----------
    points : tuple of FrequencyPoint
        At the frequencies that were asked for, ascending; their errors are correlated.
    fit : PlantFit
        The equation with its region, for predictions: the points are no independent data.
    p_values : (float, float, float)
        Of the tests in the order of ``TESTS``, each the probability of so large a departure under noise alone.
    start_s, end_s : float
        Rows that were used, in the recording's time [s].
    """

    points: tuple[FrequencyPoint, ...]
    fit: PlantFit
    p_values: tuple[float, float, float]
    start_s: float
    end_s: float

    def refused(self, look: int = 1) -> str:
        """Say what the rows show that the equation has not; empty where the points may be used.

        Parameters
        ----------
        look : int
            How often this sweep's rows were looked at, with this time: the k-th look may be wrong with LEVEL / 2^k.
        """
        least = LEVEL / 2.0**look / len(TESTS)
        shown = [what for what, p in zip(TESTS, self.p_values, strict=True) if p < least]
        return f"the rows show {' and '.join(shown)}" if shown else ""

    @property
    def worst_sd(self) -> float:
        """Largest standard deviation of a gain, relative, or of a phase, a degree counted as one per cent."""
        return max(max(gain, math.degrees(phase) / 100.0) for gain, phase in map(polar_sd, self.points))

    def to_json(self) -> dict[str, Any]:
        """Return what ``result.json`` says of it."""
        tests = dict(zip(TESTS, self.p_values, strict=True))
        return {"start_s": self.start_s, "end_s": self.end_s, "p_values": tests}


def estimate_sweep(
    recording: Recording,
    cycles: Sequence[Cycle],
    start_s: float,
    end_s: float,
    omega_rad_s: Sequence[float],
    phases_rad: Sequence[float],
) -> SweepEstimate:
    """Return the points of a sweep from all its rows together, and whether they may be used.

    Parameters
    ----------
    recording : Recording
        With the rows of the sweep, and rows before them, whose command acts on.
    cycles : sequence of (FrequencyPoint, WholePeriods)
        At least two limit cycles, each with the point of its own rows; those give starting values and enter no
        further.
    start_s, end_s : float
        Rows of y that are used, in the recording's time [s].
    omega_rad_s : sequence of float
        Frequencies of limit cycles at which points are wanted [rad/s].
    phases_rad : sequence of float
        Phases at which no limit cycle was run and a point is wanted, between those of the cycles, as they are of the
        plant, its sign included [rad].

    Raises
    ------
    IdentificationError
        No equation is determined by the rows.
    """
    kept = recording.t <= end_s
    rows = replace(recording, t=recording.t[kept], u=recording.u[kept], y=recording.y[kept], extra={})
    data = prepare(rows, start_s=start_s, past_input="held", skip_missing=True)
    largest = 0.5 * max(window.period_s for _, window in cycles)
    columns, kinds = own_columns(data.ty, [window for _, window in cycles])
    white = fit_from_points([point for point, _ in cycles], data, largest)
    whitening = colour_beside(data, min(white, key=lambda one: one.criterion), columns)
    found = fit_again(data, white, largest, Whitening(ar=whitening)) if whitening.size else white
    best = min(found, key=lambda one: one.criterion)
    p_values, excess = judge_equation(data, best, columns, kinds, whitening)
    omega = _frequencies(best, omega_rad_s, phases_rad)
    # what the cycles' own fundamentals depart by beyond noise is bias that was not large enough to be refused
    response, covariance = _average(found, omega)
    points = tuple(
        FrequencyPoint(
            omega_rad_s=float(omega[i]),
            response=complex(response[i]),
            covariance=as_pairs(excess * covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2]),
            source="sweep",
        )
        for i in range(omega.size)
    )
    fit = plant_fit([one.equation for one in found])
    widened = replace(
        fit, covariance=excess * fit.covariance, source="points", shared_errors=_shared_error_factor(covariance)
    )
    return SweepEstimate(points=points, fit=widened, p_values=p_values, start_s=start_s, end_s=end_s)


def _frequencies(best: Fitted, visited: Sequence[float], phases_rad: Sequence[float]) -> FloatArray:
    """Return the cycles' frequencies and those at which the equation has the phases, ascending [rad/s]."""
    grid = np.geomspace(min(visited), max(visited), 400)
    phase = np.angle(best.response(grid)[0])
    further = []
    for wanted in phases_rad:
        away = np.abs(np.angle(np.exp(1j * (phase - wanted))))
        further.append(float(grid[int(np.argmin(away))]))
    return np.unique([*visited, *further])


def _average(found: Sequence[Fitted], omega_rad_s: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """Return the mean response over the structures (W,), and its covariance with what they differ by (2W, 2W)."""
    criteria = np.array([one.criterion for one in found])
    weights = np.exp(-0.5 * (criteria - criteria.min()))
    weights /= weights.sum()
    each = [one.response(omega_rad_s) for one in found]
    mean = np.sum([w * G for w, (G, _) in zip(weights, each, strict=True)], axis=0)
    covariance = np.zeros((2 * omega_rad_s.size, 2 * omega_rad_s.size))
    for weight, (G, own) in zip(weights, each, strict=True):
        away = as_parts(G - mean)
        covariance += weight * (own + np.outer(away, away))
    return mean, covariance


def _shared_error_factor(covariance: FloatArray) -> float:
    """Return by how much the points' covariances are to be multiplied for their joint region of independent errors.

    Their sum of squares has the mean of independent ones and a larger spread: a scaled chi-square of the same mean and
    variance (Satterthwaite).
    """
    size = len(covariance)
    whiten = np.zeros_like(covariance)
    for i in range(0, size, 2):
        own = covariance[i : i + 2, i : i + 2]
        whiten[i : i + 2, i : i + 2] = np.linalg.inv(np.linalg.cholesky(own))
    correlation = whiten @ covariance @ whiten.T
    spread = float(np.sum(correlation**2)) / size
    return max(1.0, spread * chi2_quantile(0.95, size / spread) / chi2_quantile(0.95, size))
