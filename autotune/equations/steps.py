"""Single steps: Dormand and Prince's explicit 5(4) pair, and an L-stable Rosenbrock 2(3) pair.

Where Hairer's test finds the problem stiff, the run goes on with the second.

References
----------
E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 2nd ed., table II.5.2 of the explicit
pair; the test for stiffness is in volume II, eq. (IV.2.26).

L. F. Shampine, M. W. Reichelt, The MATLAB ODE suite, SIAM J. Sci. Comput. 18, 1997, sec. 3, of the Rosenbrock pair.
"""

from __future__ import annotations

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.in_place import in_place
from autotune.equations.switching import field, field_in_row
from autotune.equations.tape_ops import solve
from autotune.equations.work import AT_BOUND, IS_STIFF, ROW, STEP, Tape, Work

_FLOOR = 1e-14  # error that no state is asked to keep below, in its unit
_STIFF, _STIFF_STEPS = 3.25, 15  # bound of the explicit pair's stability, and how many steps at it make a stiff problem

_A = np.array(
    [
        [1 / 5, 0, 0, 0, 0, 0],
        [3 / 40, 9 / 40, 0, 0, 0, 0],
        [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
        [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
_C = np.array([1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0])
_E = np.array([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
_D = 1.0 / (2.0 + np.sqrt(2.0))
_E32 = 6.0 + np.sqrt(2.0)


@in_place(inline="always")
def _size(p: Tape, w: Work, x: FloatArray, tolerance: float) -> float:
    """Return the error in units of what is allowed; NaN where it is no number."""
    worst = 0.0
    for i in range(p.n):
        ratio = abs(w.e[i]) / (tolerance * max(w.seen[i], abs(x[i]), abs(w.y[i])) + _FLOOR)
        if not ratio <= worst:  # also for what is no number
            worst = ratio
    return worst


@in_place(inline="always")
def _explicit(p: Tape, w: Work, x: FloatArray, t: float, h: float) -> float:
    """Take one Dormand-Prince step into y with its error in e; returns Hairer's h times the fastest rate."""
    K, y, e, seen, n = w.K, w.y, w.e, w.seen, p.n
    far = change = 0.0
    for s in range(6):
        for i in range(n):
            total = 0.0
            for j in range(s + 1):
                total += _A[s, j] * K[j, i]
            new = x[i] + h * total
            if s == 5:
                far = max(far, abs(new - y[i]) / (max(seen[i], abs(new)) + 1e-300))
            y[i] = new
        field(p, w, y, t + _C[s] * h, s + 1)
    for i in range(n):
        total = 0.0
        for j in range(7):
            total += _E[j] * K[j, i]
        e[i] = h * total
        change = max(change, abs(K[6, i] - K[5, i]) / (max(seen[i], abs(y[i])) + 1e-300))
    return h * change / far if far > 1e-14 else 0.0


@in_place
def _implicit(p: Tape, w: Work, x: FloatArray, t: float, h: float) -> None:
    """Take one Rosenbrock step into y with its error in e; J and K[7] hold the Jacobian and the time derivative."""
    n, K = p.n, w.K
    for stage in range(3):
        for i in range(n):
            if stage == 0:
                w.e[i] = K[0, i] + h * _D * K[7, i]
            elif stage == 1:
                w.e[i] = K[4, i] - K[1, i]
            else:
                w.e[i] = K[6, i] - _E32 * (K[2, i] - K[4, i]) - 2.0 * (K[1, i] - K[0, i]) + h * _D * K[7, i]
            for j in range(n):
                w.W[i, j] = (1.0 if i == j else 0.0) - h * _D * w.J[i, j]
        solve(w.W, w.e, n)
        for i in range(n):
            K[stage + 1, i] = w.e[i] + (K[1, i] if stage == 1 else 0.0)
            w.y[i] = x[i] + h * (0.5 * K[1, i] if stage == 0 else K[2, i])
        if stage < 2:
            w.memory[ROW] = 4.0 if stage == 0 else 6.0
            field_in_row(p, w, w.y, t + (0.5 * h if stage == 0 else h))
    for i in range(n):
        w.e[i] = h / 6.0 * (K[1, i] - 2.0 * K[2, i] + K[3, i])


@in_place
def _jacobian(p: Tape, w: Work, x: FloatArray, t: float, h: float) -> None:
    """Fill the Jacobian and the time derivative of the field at x, which is in K[0], by differences."""
    for j in range(p.n + 1):
        for i in range(p.n):
            w.y[i] = x[i]
        step = 1e-4 * h
        if j < p.n:
            step = 1e-7 * max(w.seen[j], abs(x[j]), abs(h * w.K[0, j])) + 1e-30
            w.y[j] = x[j] + step
        w.memory[ROW] = 6.0
        field_in_row(p, w, w.y, t + (step if j == p.n else 0.0))
        for i in range(p.n):
            if j < p.n:
                w.J[i, j] = (w.K[6, i] - w.K[0, i]) / step
            else:
                w.K[7, i] = (w.K[6, i] - w.K[0, i]) / step


@in_place(inline="always")
def trial(p: Tape, w: Work, x: FloatArray, t: float, h: float, tolerance: float, new_point: bool) -> float:
    """Try a step into y and return its error in units of what is allowed.

    Parameters
    ----------
    p : Tape
        The program.
    w : Work
        What is written on.
    x : (n,) array
        State before the step.
    t, h : float
        Time and length of the step [s].
    tolerance : float
        Relative error that is allowed.
    new_point : bool
        Whether nothing was tried from this state yet.
    """
    if w.memory[IS_STIFF] > 0.0:
        if new_point:
            _jacobian(p, w, x, t, h)
        _implicit(p, w, x, t, h)
        return float(_size(p, w, x, tolerance))
    rate = _explicit(p, w, x, t, h)
    w.memory[AT_BOUND] = w.memory[AT_BOUND] + 1.0 if rate > _STIFF else 0.0
    if w.memory[AT_BOUND] >= _STIFF_STEPS:
        w.memory[IS_STIFF] = 1.0
    return float(_size(p, w, x, tolerance))


@in_place(inline="always")
def next_step(w: Work, error: float, h: float) -> None:
    """Remember the step that the error allows; one that was cut short leaves a longer one as it was.

    Parameters
    ----------
    w : Work
        Its memory keeps the step.
    error : float
        Of the step that was tried, in units of what is allowed.
    h : float
        Its length [s].
    """
    power = -1.0 / 3.0 if w.memory[IS_STIFF] > 0.0 else -0.2
    if not np.isfinite(error):
        w.memory[STEP] = 0.25 * h
    elif error > 1.0:
        w.memory[STEP] = h * max(0.2, 0.9 * error**power)
    else:
        grown = h * (5.0 if error < 1e-9 else min(5.0, 0.9 * error**power))
        w.memory[STEP] = grown if grown < h else max(w.memory[STEP], grown)
