"""The a-posteriori method of Ollivier, Moutaouakil and Sadik (2007), section 3: least squares on modulated intervals.

For every interval (T_1, T_2) of length L the equation of the system, multiplied by f((t - T_1)/L) and integrated by
parts, is linear in a_i, b and in a correction of the delay. u is then shifted by the delay found, and the step repeated
to a fixed point.

This is the paper's own estimate, biased by noise; without that bias it is
:func:`autotune.identification.delay.methods.algebraic_delay`.

Misprint of the paper: its example prints h_0 + a cos(b_2/b_0); the step that has the fixed point is
(L/2 pi) atan2(b_2, b_1), which also takes about five iterations where an unscaled arctangent takes fifty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import fdtri

from autotune.arrays import BoolArray
from autotune.errors import InputError
from autotune.identification.delay.modulated_integrals import Interval, Modulated, modulated_by_fourier_sums
from autotune.recording import Recording

#: Fixed points this far below zero, in intervals, are noise about a delay of zero; further below they are none.
_EARLY = 0.02
#: A fixed point is another delay's where the equations at some delay of a grid leave so much less that noise alone
#: does it once in so many times (F test).
_BY_CHANCE = 1e-6
#: what the integrals' own errors may leave
_EXACT = 1e-6
_GRID = 32  # delays per interval
_RESTARTS = 6
_ITERATIONS = 50


@dataclass(frozen=True, kw_only=True)
class ModulatedDelay:
    """Result of the a-posteriori method.

    Attributes
    ----------
    a : tuple of n floats
        a_0..a_{n-1}.
    b, delay_s : float
        Input gain and delay [s].
    iterations : int
        Steps taken to the fixed point.
    converged : bool
        Whether a delay was found at which nothing is lacking: the last step was below a millionth of the intervals'
        length, the delay is not negative, b has the sign that the step took it to have, and no other delay explains
        the intervals better than noise does by chance. What is not converged is no estimate.
    residual : float
        What the equations leave at the delay and with one gain, as a share of the mean square of their right-hand side,
        degrees of freedom counted.
    """

    a: tuple[float, ...]
    b: float
    delay_s: float
    iterations: int
    converged: bool
    residual: float


def modulated_delay(recording: Recording, order: int, intervals: Sequence[Interval]) -> ModulatedDelay:
    """Estimate a, b and h by modulating functions and least squares over intervals, iterating on h from 0.

    Where the iteration from there has no fixed point that holds, it is begun again from the delays of a grid that
    explain the intervals best. The modulating function is sin^n for even n and sin^(n+1) for odd n.

    Parameters
    ----------
    recording : Recording
        u from ``T_1 - h`` on, y from ``T_1`` on, both linear between rows.
    order : int
        Order n.
    intervals : sequence of (float, float)
        (T_1, T_2) [s], all of one length; more than unknowns.

    Returns
    -------
    ModulatedDelay
        Look at ``converged`` first.

    Raises
    ------
    InputError
        Fewer intervals than unknowns, or of unequal lengths.

    Notes
    -----
    Without noise and with intervals of 15 s, Example 2 is recovered for delays up to 6.8 s, at noise 5 up to 6 s,
    without a second start: the basin is a bit under half the interval. Least squares with noise in its regressors is
    biased towards zero (Table 1: b = 1.94 for 2 at noise 5), and breaks under coloured noise; its standard deviations
    are 34 to 83 times the Cramer-Rao bound.

    References
    ----------
    Section 3, the equation E_(T1,T2),x,u, and Example 2.
    """
    lengths = np.array([T_2 - T_1 for T_1, T_2 in intervals])
    if np.ptp(lengths) > 1e-9 * lengths.max():
        raise InputError("intervals of unequal lengths", where="intervals", remedy="give them one length")
    recording.require_finite()
    modulated = modulated_by_fourier_sums(recording, order, intervals)
    unknowns = order + modulated.whole.size

    def within(h: float) -> int:
        return int(_inside(recording, intervals, h).sum())

    if within(0.0) < unknowns:
        raise InputError(
            f"{len(intervals)} intervals, of which {within(0.0)} within the record, for {unknowns} unknowns",
            where="intervals",
            remedy="give more intervals",
        )
    starts = _best_of_a_grid(recording, intervals, modulated)
    others = [(within(other) - unknowns, residual) for other, residual in starts]

    def largest_residual(h: float) -> float:
        """Return what a delay may leave beside all others, each with the intervals that it has in the record."""
        own = within(h) - unknowns
        if own <= 0:  # explained whatever the delay is: none of them is told from another
            return np.inf if within(0.0) == unknowns else 0.0
        shares = (float(fdtri(own, n, 1.0 - _BY_CHANCE)) * residual for n, residual in others if n > 0)
        return float(min(shares, default=0.0)) + _EXACT

    estimates: list[ModulatedDelay] = []
    for start in (0.0, *(h for h, _ in starts)):
        for sign in (1.0, -1.0):  # the wrong sign of b has its fixed point half a window away
            result = _iterate(recording, intervals, modulated, start, sign)
            allowed = largest_residual(result.delay_s)
            estimates.append(replace(result, converged=result.converged and result.residual <= allowed))
            if estimates[-1].converged and within(result.delay_s) == within(0.0):
                return estimates[-1]
    # a delay that leaves hardly more intervals in the record than unknowns explains these, whatever it is
    return min(estimates, key=lambda result: (not result.converged, -within(result.delay_s), result.residual))


def _iterate(
    recording: Recording, intervals: Sequence[Interval], modulated: Modulated, h: float, sign: float
) -> ModulatedDelay:
    """Repeat least squares and delay step to the fixed point; sign is b's."""
    Y = modulated.output
    n = Y.shape[1] - 1
    length = intervals[0][1] - intervals[0][0]
    step, count, solution = np.inf, 0, np.zeros(n + modulated.whole.size)
    while count < _ITERATIONS and abs(step) > 1e-6:
        inside = _inside(recording, intervals, h)
        # sum (-1)^i L^-i a_i I_{y,f^(i)} + b I_{u_h,f} + .. = (-1)^n L^-n I_{y,f^(n)}
        matrix = np.column_stack([Y[:, :n], modulated.of_input(h)])[inside]
        if matrix.shape[0] < matrix.shape[1]:
            break
        solution = np.linalg.lstsq(matrix, Y[inside, n], rcond=None)[0]
        step = modulated.step(solution[n:], sign)
        h += step * length
        count += 1
    b = solution[n:]
    fixed = abs(step) <= 1e-6 and h >= -_EARLY * length and sign * b[0] >= 0.0
    return ModulatedDelay(
        a=tuple(float(value) for value in solution[:n]),
        b=float(b[0]),
        delay_s=float(h),
        iterations=count,
        converged=bool(fixed),
        residual=_residual(recording, intervals, modulated, h),
    )


def _residual(recording: Recording, intervals: Sequence[Interval], modulated: Modulated, h: float) -> float:
    """Return what the equations leave at a delay, with one gain; infinite with too few intervals."""
    inside = _inside(recording, intervals, h)
    Y = modulated.output[inside]
    if len(Y) < Y.shape[1] - 1 + modulated.whole.size:
        return float("inf")
    of_u = (modulated.of_input(h) @ modulated.whole)[inside]
    matrix = np.column_stack([Y[:, :-1], of_u])
    residual = Y[:, -1] - matrix @ np.linalg.lstsq(matrix, Y[:, -1], rcond=None)[0]
    total = float(Y[:, -1] @ Y[:, -1]) * (1.0 - matrix.shape[1] / len(Y))
    return float(residual @ residual) / total if total > 0.0 else float("inf")


def _best_of_a_grid(
    recording: Recording, intervals: Sequence[Interval], modulated: Modulated
) -> list[tuple[float, float]]:
    """Return the delays at which the residual has its lowest minima, and that residual, the least first."""
    longest = max(T_2 - T_1 for T_1, T_2 in intervals)
    reach = max(T_1 for T_1, _ in intervals) - float(recording.t[0])
    grid = np.arange(0.0, max(reach, 0.0) + 1e-9, longest / _GRID)

    def residual(h: float) -> float:
        return min(_residual(recording, intervals, modulated, float(h)), 1e9)

    values = np.array([residual(h) for h in grid])
    padded = np.concatenate([[np.inf], values, [np.inf]])
    minima = np.flatnonzero((values < 1e9) & (values <= padded[:-2]) & (values <= padded[2:]))
    candidates = []
    for i in minima[np.argsort(values[minima])][:_RESTARTS]:
        around = (max(grid[i] - longest / _GRID, 0.0), grid[i] + longest / _GRID)
        fine = minimize_scalar(residual, bounds=around, method="bounded", options={"xatol": 1e-3 * longest})
        candidates.append(min((float(values[i]), float(grid[i])), (float(fine.fun), float(fine.x))))
    return [(h, value) for value, h in sorted(candidates)]


def _inside(recording: Recording, intervals: Sequence[Interval], h: float) -> BoolArray:
    """Return which intervals, shifted back by the delay, lie within the record."""
    ends = np.asarray(intervals, dtype=np.float64) - h
    slack = 1.5 * (recording.t[-1] - recording.t[0]) / (len(recording) - 1)
    inside = (ends[:, 0] >= recording.t[0] - slack) & (ends[:, 1] <= recording.t[-1] + slack)
    return np.asarray(inside, dtype=np.bool_)
