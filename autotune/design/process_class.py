"""Every aperiodic process with dead time that agrees with measured points: what H(j omega) can be between them.

The prior is the class

    H(s) = G s^-m exp(-s L) prod_k (1 + s T_k)^(-mu_k) ((1 - s a_k)/(1 + s a_k))^(nu_k) (1 - s a_k)^(zeta_k),
    0 <= m <= 1, L >= 0, mu_k >= 0, nu_k >= 0, zeta_k >= 0, sum zeta_k <= 1,

any number of lags at any time constants, at most one integrator, dead time, and (if asked for) inverse response: any
number of all-pass factors of unit gain, and one zero in the right half plane, which no lag need be as slow as, so that
the gain may rise before it falls. Integer exponents are the physical processes; real ones enlarge the class, which only
makes a guarantee stricter, and make log H linear in (log G, m, L, mu, nu, zeta): what the points allow at another
frequency is a linear program. The reduced models (8) and (24) are members with inverse response; members without a zero
fulfil (1) but for its strictness. A process with lightly damped poles is not in the class; its points are refused as
contradicting it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linprog, nnls

from autotune.arrays import BoolArray, FloatArray
from autotune.design.specification import PROBABILITY
from autotune.errors import DesignError
from autotune.points import FrequencyPoint

if TYPE_CHECKING:
    import highspy

DIRECTIONS = 12
_FACETS = 12
_ATOMS_PER_DECADE = 16
_RESOLUTION = 5e-4  # what the grid of time constants cannot represent, in log gain and in radians
#: probability below which points that miss the class contradict it
_CONTRADICTED = 1e-3
#: what may be missed beyond the regions, in log gain and in radians: where abs(L) is near one half, as it is next to
#: the critical point, a hundredth moves a modulus margin of one half by one per cent, and beyond the highest point what
#: is missed grows several times (a plant that was missed by .005 lost 1.8 %)
_MATERIAL = 0.002
#: HiGHS's numbers for its simplex methods
_DUAL, _PRIMAL = 1, 4


@dataclass(frozen=True, kw_only=True, eq=False)
class ConsistentProcesses:
    """The members of the class that pass through the region of every point.

    Attributes
    ----------
    sign : float
        Sign of the plant's gain.
    lags_s, inverse_s : (n,), (k,) array
        Time constants T_k and a_k of the grid [s].
    facets, limits : (F, V), (F,) array
        facets x <= limits are the regions, and the sum of zeta; x = (log G, m, L omega_0, mu, nu, zeta).
    omega_0 : float
        Unit of frequency [rad/s].
    nominal : (V,) array
        Of the members without a zero the one closest to the points (weighted least squares).
    inflation : float
        Factor by which the regions had to be enlarged before any member passed through all of them; 1 where none.
    omega_points : (N,) array
        Frequencies of the points [rad/s].
    """

    sign: float
    lags_s: FloatArray
    inverse_s: FloatArray
    facets: FloatArray
    limits: FloatArray
    omega_0: float
    nominal: FloatArray
    inflation: float
    omega_points: FloatArray

    def rows(self, omega_rad_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (M, V) matrices of log gain and of phase [rad] at the frequencies: both linear in x."""
        return _rows(np.asarray(omega_rad_s, dtype=np.float64), self.lags_s, self.inverse_s, self.omega_0)

    def nominal_log(self, omega_rad_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log gain and unwrapped phase [rad] of the nominal member, sign taken out."""
        gain, phase = self.rows(omega_rad_s)
        return gain @ self.nominal, phase @ self.nominal

    def supports(self, omega_rad_s: FloatArray) -> FloatArray:
        """Return (M, DIRECTIONS) support values of what (log gain, phase) can be at each frequency.

        Column d is the largest cos(t_d) log gain + sin(t_d) phase, t_d = 2 pi d/DIRECTIONS: tangents all around.
        """
        gain, phase = self.rows(omega_rad_s)
        angles = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
        # direction by direction: the next frequency's vertex is the last one's or its neighbour
        costs = np.cos(angles)[:, None, None] * gain + np.sin(angles)[:, None, None] * phase
        return self._largest(costs.reshape(-1, gain.shape[1]), "plant").reshape(DIRECTIONS, len(gain)).T

    def curvatures(self, omega_rad_s: FloatArray) -> FloatArray:
        """Return (M,) bounds on the second derivative of log H by log omega: how far it can leave a chord."""
        x = np.asarray(omega_rad_s)[:, None]
        # by log omega: log gain 2 w^2/(1 + w^2)^2, phase w (1 - w^2)/(1 + w^2)^2, w = omega T: modulus w/(1 + w^2)
        lag, inverse = x * self.lags_s, x * self.inverse_s
        columns = [np.zeros_like(x), np.zeros_like(x), x / self.omega_0]
        turns = inverse / (1.0 + inverse**2)
        return self._largest(np.hstack((*columns, lag / (1.0 + lag**2), 2.0 * turns, turns)), "curvature")

    def _largest(self, costs: FloatArray, what: str) -> FloatArray:
        """Return max cost x over the members for every row of ``costs``; each program starts where the last ended."""
        program = _program(self.facets, self.limits)
        columns = np.arange(costs.shape[1], dtype=np.int32)
        values = np.empty(len(costs))
        for k, cost in enumerate(costs):
            program.changeColsCost(len(columns), columns, cost)
            values[k] = _maximum(program, what)
        return values


def _maximum(program: highspy.Highs, what: str) -> float:
    """Return the maximum of a program, solved from the last vertex or, where that stays undecided, from the beginning.

    Neighbouring lags are so nearly alike that now and then the last vertex's basis is too ill conditioned for the
    solver to decide anything, which says nothing about the points: their regions bound every member.
    """
    import highspy

    program.run()
    if program.getModelStatus() != highspy.HighsModelStatus.kOptimal:
        program.clearSolver()
        program.setOptionValue("simplex_strategy", _DUAL)
        program.run()
        program.setOptionValue("simplex_strategy", _PRIMAL)
    status = program.getModelStatus()
    if status != highspy.HighsModelStatus.kOptimal:
        raise DesignError(
            f"what the points allow of the {what} was not found: a linear program ended with {status.name}",
            where="points",
            remedy="leave out points that are close together, or add some that are apart",
        )
    return float(program.getInfo().objective_function_value)


def _program(A: FloatArray, b: FloatArray) -> highspy.Highs:
    """Return max 0 x subject to A x <= b and the class's bounds on x, ready for its costs."""
    import highspy

    F, V = A.shape
    lower, upper = np.zeros(V), np.full(V, np.inf)
    lower[0], upper[1] = -np.inf, 1.0
    program = highspy.HighsLp()
    program.num_col_, program.num_row_ = V, F
    program.col_cost_, program.col_lower_, program.col_upper_ = np.zeros(V), lower, upper
    program.row_lower_, program.row_upper_ = np.full(F, -np.inf), b
    program.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
    program.a_matrix_.start_ = np.arange(F + 1) * V
    program.a_matrix_.index_ = np.tile(np.arange(V), F)
    program.a_matrix_.value_ = A.ravel()
    program.sense_ = highspy.ObjSense.kMaximize
    solver = highspy.Highs()  # type: ignore[no-untyped-call] # its constructor has no annotations
    solver.setOptionValue("output_flag", False)
    solver.setOptionValue("threads", 1)
    solver.setOptionValue("presolve", "off")
    solver.setOptionValue("solver", "simplex")
    solver.setOptionValue("simplex_strategy", _PRIMAL)  # a changed cost leaves the last vertex feasible
    solver.passModel(program)
    return solver


#: rounding of a covariance that was turned, as a share of its trace
_ROUNDING = 1e-14


def consistent_processes(points: Sequence[FrequencyPoint]) -> ConsistentProcesses:
    """Return the class's members that pass through the joint region of the points.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        At least three, the lowest with a phase above -180 degrees (of the plant with positive gain).

    Raises
    ------
    DesignError
        Too few points, or points that contradict the class and each other; names the worst.
    """
    if len(points) < 3:
        raise DesignError(f"{len(points)} points", where="points", remedy="a design on points needs at least three")
    ordered = sorted(points, key=lambda point: point.omega_rad_s)
    omega = np.array([point.omega_rad_s for point in ordered])
    sign, log_gain, phase = _log_polar(ordered)
    omega_0 = float(np.exp(np.mean(np.log(omega))))
    lags = _geometric(0.02 / omega[-1], 50.0 / omega[0])
    inverse = _geometric(0.02 / omega[-1], 5.0 / omega[0])
    gain_rows, phase_rows = _rows(omega, lags, inverse, omega_0)
    # each point's own region is of probability^(1/N), so that all N hold together
    radius = math.sqrt(-2.0 * math.log(1.0 - PROBABILITY ** (1.0 / len(ordered))))
    facets, centre, sd = [], [], []
    whitened_rows, whitened = [], []
    for i, point in enumerate(ordered):
        covariance = _log_covariance(point)
        # the second floor is the rounding of a region that is far longer than wide
        covariance = covariance + (_RESOLUTION**2 + _ROUNDING * np.trace(covariance)) * np.eye(2)
        root = np.linalg.cholesky(covariance)
        rows, measured = np.stack((gain_rows[i], phase_rows[i])), np.array([log_gain[i], phase[i]])
        inverse_root = np.linalg.inv(root)
        whitened_rows.append(inverse_root @ rows)
        whitened.append(inverse_root @ measured)
        angles = 2.0 * np.pi * (np.arange(_FACETS) + 0.5 * (i % 2)) / _FACETS
        normals = np.stack((np.cos(angles), np.sin(angles)), axis=1) @ inverse_root
        facets.append(normals @ rows)
        centre.append(normals @ measured)
        sd.append(math.sqrt(float(np.linalg.eigvalsh(covariance)[-1])))
    A, b = np.vstack(facets), np.concatenate(centre)
    zeta = np.arange(A.shape[1]) >= A.shape[1] - inverse.size
    inflation = _inflation(A, b, zeta, omega, radius, np.array(sd))
    nominal = _closest(np.vstack(whitened_rows)[:, ~zeta], np.concatenate(whitened))
    return ConsistentProcesses(
        sign=sign,
        lags_s=lags,
        inverse_s=inverse,
        facets=np.vstack((A, zeta)),
        limits=np.append(b + inflation * radius, 1.0),
        omega_0=omega_0,
        nominal=np.append(nominal, np.zeros(inverse.size)),
        inflation=inflation,
        omega_points=omega,
    )


def _geometric(low: float, high: float) -> FloatArray:
    return np.geomspace(low, high, int(_ATOMS_PER_DECADE * math.log10(high / low)) + 1)


def _bounds(count: int) -> list[tuple[float | None, float | None]]:
    return [(None, None), (0.0, 1.0)] + [(0.0, None)] * (count - 2)


def _rows(omega: FloatArray, lags: FloatArray, inverse: FloatArray, omega_0: float) -> tuple[FloatArray, FloatArray]:
    x = omega[:, None]
    one, none = np.ones_like(x), np.zeros((len(omega), len(inverse)))
    falls, rises = -0.5 * np.log1p((x * lags) ** 2), 0.5 * np.log1p((x * inverse) ** 2)
    gain = np.hstack((one, -np.log(x / omega_0), 0.0 * x, falls, none, rises))
    turns = np.arctan(x * inverse)
    phase = np.hstack((0.0 * x, -0.5 * np.pi * one, -x / omega_0, -np.arctan(x * lags), -2.0 * turns, -turns))
    return gain, phase


def _log_polar(ordered: Sequence[FrequencyPoint]) -> tuple[float, FloatArray, FloatArray]:
    """Return the plant's sign, log gains and unwrapped phases with the sign taken out, the first within (-pi, 0]."""
    response = np.array([point.response for point in ordered])
    sign = -1.0 if 0.0 < np.angle(response[0]) <= np.pi else 1.0
    phase = np.unwrap(np.angle(sign * response))
    if phase[0] > 0.0:
        phase = phase - 2.0 * np.pi
    return sign, np.log(np.abs(response)), phase


def _log_covariance(point: FrequencyPoint) -> FloatArray:
    """Covariance of (log gain, phase) from that of (re, im), to first order."""
    re, im = point.response.real, point.response.imag
    J = np.array([[re, im], [-im, re]]) / abs(point.response) ** 2
    return np.asarray(J @ np.array(point.covariance) @ J.T)


def _inflation(
    A: FloatArray, b: FloatArray, zeta: BoolArray, omega: FloatArray, radius: float, sd: FloatArray
) -> float:
    """Return how far the regions must grow for one member to pass through all of them, with a tenth to spare.

    A class that passes by the points by more than chance allows is the wrong one, and what it says between and beyond
    them is no guarantee, however large the regions are made; unless what it misses is too little to matter.
    """
    V = A.shape[1]
    result = linprog(
        np.append(np.zeros(V), 1.0),
        A_ub=np.block([[A, np.full((len(A), 1), -radius)], [zeta.astype(np.float64), 0.0]]),
        b_ub=np.append(b, 1.0),
        bounds=[*_bounds(V), (0.0, None)],
        method="highs-ds",
    )
    if result.status != 0 or result.x is None:
        raise DesignError("the points determine no process", where="points", remedy="check their gains and phases")
    least = float(result.x[-1])
    distance = np.max((A @ result.x[:-1] - b).reshape(len(omega), _FACETS), axis=1)  # in standard deviations
    missed = np.maximum(distance - radius, 0.0) * sd
    by_chance = len(omega) * math.exp(-0.5 * (least * radius) ** 2)
    if by_chance < _CONTRADICTED and np.max(missed) > _MATERIAL:
        raise DesignError(
            "the points contradict each other as those of an aperiodic process with dead time: their regions would "
            f"have to be {least:.1f} times as large, the one at {omega[int(np.argmax(missed))]:.4g} rad/s first of all",
            where="points",
            remedy="measure that point again, or design on a model if the plant resonates",
        )
    return max(1.0, 1.1 * least)


def _closest(rows: FloatArray, measured: FloatArray) -> FloatArray:
    """Return the member of least weighted squares: non-negative least squares, log G split into two signs."""
    system = np.hstack((rows[:, :1], -rows[:, :1], rows[:, 1:]))
    solution, _ = nnls(system, measured, maxiter=50 * system.shape[1])
    x = np.append(solution[0] - solution[1], solution[2:])
    if x[1] > 1.0:  # more than one integrator: take one and fit the rest again
        rest, _ = nnls(np.delete(system, 2, axis=1), measured - rows[:, 1], maxiter=50 * system.shape[1])
        x = np.concatenate(([rest[0] - rest[1], 1.0], rest[2:]))
    return x
