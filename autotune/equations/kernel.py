"""The compiled integration of a tape along a recording's rows.

Between two rows, and between the delayed changes of inputs, the right-hand side is smooth but for switched terms.
Their modes are held within a step, so that the method keeps its order; a step over which a switching function
changes sign is cut at the crossing. Where both sides lead back to the surface (dry friction at rest, a rate limiter
that has caught up) the state slides on it with Filippov's convex combination [1]_: friction sticks, exactly.

Explicit steps are Dormand and Prince's 5(4) pair [2]_; where Hairer's test finds the problem stiff, the run goes on
with Shampine and Reichelt's L-stable Rosenbrock 2(3) pair [3]_.

References
----------
.. [1] A. F. Filippov, Differential Equations with Discontinuous Righthand Sides, Kluwer, 1988, ch. 2.
.. [2] E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 2nd ed., table II.5.2; the test
   for stiffness is in volume II, eq. (IV.2.26).
.. [3] L. F. Shampine, M. W. Reichelt, The MATLAB ODE suite, SIAM J. Sci. Comput. 18, 1997, sec. 3.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from autotune.arrays import FloatArray, IntArray
from autotune.equations.in_place import COMPILED, in_place
from autotune.equations.tape_ops import evaluate, solve, tangents

#: Why a window ended: as asked; a derivative that is no number; more steps or a larger state than is sensible.
DONE, NOT_A_NUMBER, TOO_MANY_STEPS = 0, 1, 2
MOST_STEPS = 20_000  # between two rows
MOST_ON_AVERAGE = 200  # between two rows, over a window: else one fit of a chattering model would take hours
SPARE_ROWS = 2000  # so many rows' steps may be taken ahead: a few hard places are carried through
MOST_CROSSINGS = 100  # located between two rows; further ones are taken at the end of their steps
_SURFACE = 1e-11  # of a switching function's largest value: as good as zero
_NEAR = 1e-6  # likewise, for a state that slides already
_LOCATED = 1e-9  # of the time between rows: how closely a crossing is located
_LARGEST = 1e15  # a state beyond runs away
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

#: Places in the memory of a run: the last step [s], whether it is stiff, steps and crossings since the last row,
#: successive steps at the stability bound, the row of K that is filled (an argument that is written as a number would
#: have the function compiled once for every such number).
_STEP, _IS_STIFF, _STEPS, _CROSSINGS, _AT_BOUND, _ROW = 0, 1, 2, 3, 4, 5


class Tape(NamedTuple):
    """A program's arrays, see :class:`autotune.equations.tape.Program`; n states."""

    code: IntArray
    still: int
    dynamic: int
    slopes: IntArray
    outputs: IntArray
    switches: IntArray
    modes: IntArray
    ties: IntArray
    linear: IntArray
    n: int


class Work(NamedTuple):
    """What an integration writes on.

    ``r`` registers, ``d`` their tangents; inputs are ``base + ramp (t - since[0])``; switches: whether ``sliding`` or
    ``crossed``, how far ``over`` the edge of its mode, and that ``before`` and ``beyond`` a crossing that is located,
    speed ``g_dot``, offset ``zero``, ``largest`` value; ``A b`` and ``J W`` linear systems; ``K`` fields
    at the stages, ``y`` the new state, ``e`` its error, ``seen`` the largest magnitudes; ``memory`` from step to step.
    """

    r: FloatArray
    d: FloatArray
    base: FloatArray
    ramp: FloatArray
    since: FloatArray
    sliding: IntArray
    crossed: IntArray
    over: FloatArray
    before: FloatArray
    beyond: FloatArray
    g_dot: FloatArray
    zero: FloatArray
    largest: FloatArray
    A: FloatArray
    b: FloatArray
    J: FloatArray
    W: FloatArray
    K: FloatArray
    y: FloatArray
    e: FloatArray
    seen: FloatArray
    memory: FloatArray


@njit(**COMPILED)
def _work(p: Tape, template: FloatArray, parameters: FloatArray) -> Work:
    """Return room for an integration, with everything that depends on parameters alone computed."""
    n, m, s = p.n, p.linear.size, p.switches.size
    r = template.copy()
    for i in range(parameters.size):
        r[1 + n + m + i] = parameters[i]
    evaluate(p.code, 0, p.still, r, False)
    return Work(
        r, np.zeros(r.size), np.zeros(m), np.zeros(m), np.zeros(1), np.zeros(s, dtype=np.int64),
        np.zeros(s, dtype=np.int64), np.zeros(s), np.zeros(s), np.zeros(s), np.zeros(s), np.zeros(s), np.zeros(s),
        np.zeros((s, s)), np.zeros(s), np.zeros((n, n)), np.zeros((n, n)), np.zeros((8, n)), np.zeros(n), np.zeros(n),
        np.zeros(n), np.zeros(6),
    )  # fmt: skip


@in_place(inline="always")
def _evaluate_slopes(p: Tape, w: Work, row: int) -> None:
    r, K, slopes = w.r, w.K, p.slopes
    evaluate(p.code, p.still, p.dynamic, r, 0 < row < 6)  # rows 0 and 6 of K are ends of steps, the others stages
    for i in range(p.n):
        K[row, i] = r[slopes[i]]


@in_place
def _speeds_of_switches(p: Tape, w: Work) -> None:
    """Find how fast each switching function runs along the field in the filled row of K, modes fixed."""
    row = int(w.memory[_ROW])
    for i in range(w.d.size):
        w.d[i] = 0.0
    w.d[0] = 1.0
    for i in range(p.n):
        w.d[1 + i] = w.K[row, i]
    for j in range(w.ramp.size):
        w.d[1 + p.n + j] = w.ramp[j]
    tangents(p.code, p.still, p.dynamic, w.r, w.d)
    for k in range(p.switches.size):
        w.g_dot[k] = w.d[p.switches[k]]


@in_place(inline="always")
def _field(p: Tape, w: Work, x: FloatArray, t: float, row: int) -> None:
    """Evaluate the derivatives into a row of K; modes of sliding switches keep the state on the surface."""
    r, base, ramp, n = w.r, w.base, w.ramp, p.n
    begun = t - w.since[0]
    r[0] = t
    for i in range(n):
        r[1 + i] = x[i]
    for j in range(base.size):
        r[1 + n + j] = base[j] + ramp[j] * begun
    count = 0
    for k in range(p.switches.size):
        if w.sliding[k]:
            r[p.modes[k]] = 0.0
            count += 1
    _evaluate_slopes(p, w, row)
    w.memory[_ROW] = row
    if count > 0:
        _slide(p, w, count)


@in_place
def _field_in_row(p: Tape, w: Work, x: FloatArray, t: float) -> None:
    """Do as :func:`_field`, into the row that the memory names: a call, where time does not count."""
    _field(p, w, x, t, int(w.memory[_ROW]))


@in_place
def _slide(p: Tape, w: Work, count: int) -> None:
    """Find the modes that keep sliding switches still: their speeds are linear in the modes."""
    at = int(w.memory[_ROW])
    _speeds_of_switches(p, w)
    row = 0
    for k in range(p.switches.size):
        if w.sliding[k]:
            w.b[row] = -w.g_dot[k]
            row += 1
    column = 0
    for k in range(p.switches.size):
        if not w.sliding[k]:
            continue
        w.r[p.modes[k]] = 1.0
        _evaluate_slopes(p, w, at)
        _speeds_of_switches(p, w)
        w.r[p.modes[k]] = 0.0
        row = 0
        for other in range(p.switches.size):
            if w.sliding[other]:
                w.A[row, column] = w.g_dot[other] + w.b[row]
                row += 1
        column += 1
    solve(w.A, w.b, count)
    row = 0
    for k in range(p.switches.size):
        if w.sliding[k]:
            w.r[p.modes[k]] = w.b[row]
            row += 1
    _evaluate_slopes(p, w, at)


@in_place
def _settle(p: Tape, w: Work, x: FloatArray, t: float) -> None:
    """Set every switch's mode for the state and inputs of now, one side or sliding, and the field in K[0]."""
    for _ in range(3):
        changed = False
        for k in range(p.switches.size):
            w.memory[_ROW] = 5.0
            _field_in_row(p, w, x, t)  # as a stage: just beyond the edge of a root its mode is not changed yet
            g, mode = w.r[p.switches[k]] - w.zero[k], w.r[p.modes[k]]
            w.largest[k] = max(w.largest[k], abs(g))
            near = abs(g) <= _NEAR * w.largest[k]
            slid = w.sliding[k]
            if slid and near and abs(mode) <= 1.0:
                continue
            w.sliding[k] = 0
            if w.crossed[k] or abs(g) <= _SURFACE * w.largest[k] or (slid and near):
                _choose(p, w, x, t, k, mode, g)
            else:
                w.r[p.modes[k]] = 1.0 if g > 0.0 else -1.0
                w.zero[k] = 0.0
            w.crossed[k] = 0
            changed = changed or slid != w.sliding[k] or (not slid and mode != w.r[p.modes[k]])
        if not changed:
            break
    w.memory[_ROW] = 0.0
    _field_in_row(p, w, x, t)


@in_place
def _choose(p: Tape, w: Work, x: FloatArray, t: float, k: int, before: float, g: float) -> None:
    """Set the mode of a switch whose function is at zero by where the fields of both sides lead."""
    mode = p.modes[k]
    w.memory[_ROW] = 5.0
    w.r[mode] = 1.0
    _field_in_row(p, w, x, t)
    _speeds_of_switches(p, w)
    above = w.g_dot[k]
    w.r[mode] = -1.0
    _field_in_row(p, w, x, t)
    _speeds_of_switches(p, w)
    below = w.g_dot[k]
    if above < 0.0 < below:
        w.sliding[k] = 1
        w.zero[k] += g
    elif above == 0.0 and below == 0.0:
        w.r[mode] = p.ties[k]
    elif above >= 0.0 and below >= 0.0:
        w.r[mode] = 1.0
    elif above <= 0.0 and below <= 0.0:
        w.r[mode] = -1.0
    else:  # both sides lead away
        w.r[mode] = before if abs(before) == 1.0 else 1.0


@in_place
def _crossing(p: Tape, w: Work) -> bool:
    """Return whether a mode no longer fits the registers of now, and mark which."""
    found = False
    for k in range(p.switches.size):
        mode = w.r[p.modes[k]]
        if w.sliding[k]:
            w.over[k] = abs(mode) - 1.0
            out = w.over[k] > 1e-9
        else:
            g = w.r[p.switches[k]] - w.zero[k]
            w.over[k] = abs(g) if mode == 0.0 else -g if mode == 1.0 else g
            out = w.over[k] > _SURFACE * w.largest[k]
        w.crossed[k] = 1 if out else 0
        found = found or out
    return found


@in_place
def _copy(a: FloatArray, b: FloatArray) -> None:
    for i in range(a.size):
        b[i] = a[i]


@in_place
def _halve(a: FloatArray) -> None:
    for i in range(a.size):
        a[i] *= 0.5


@in_place
def _begin_locating(p: Tape, w: Work, x: FloatArray, t: float) -> None:
    """Remember how far modes are over their edges where a step ends beyond a crossing, and where it began."""
    _copy(w.over, w.beyond)
    w.memory[_ROW] = 5.0
    _field_in_row(p, w, x, t)
    _crossing(p, w)
    _copy(w.over, w.before)


@in_place
def _located(w: Work, low: float, high: float, close: float, side: int, halve: bool) -> float:
    """Return the step to try next between one before a crossing and one beyond it: false position, or half way.

    ``side`` says whether the last one tried lay beyond (1) or before (-1): the next is put a little to the other side
    of the estimate, so that the bracket closes from both ends.
    """
    found = 2.0 * high
    for k in range(w.over.size):
        a, b = w.before[k], w.beyond[k]
        if b > 0.0 and -a > 1e-6 * b:
            found = min(found, low - (high - low) * a / (b - a))
        elif b > 0.0 or np.isnan(b):
            halve = True
    if halve or not found < high:
        return 0.5 * (low + high)
    return min(max(found - 0.4 * side * close, low + 0.2 * close), high - 0.2 * close)


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
        _field(p, w, y, t + _C[s] * h, s + 1)
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
            w.memory[_ROW] = 4.0 if stage == 0 else 6.0
            _field_in_row(p, w, w.y, t + (0.5 * h if stage == 0 else h))
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
        w.memory[_ROW] = 6.0
        _field_in_row(p, w, w.y, t + (step if j == p.n else 0.0))
        for i in range(p.n):
            if j < p.n:
                w.J[i, j] = (w.K[6, i] - w.K[0, i]) / step
            else:
                w.K[7, i] = (w.K[6, i] - w.K[0, i]) / step


@in_place(inline="always")
def _trial(p: Tape, w: Work, x: FloatArray, t: float, h: float, tolerance: float, new_point: bool) -> float:
    """Try a step into y and return its error in units of what is allowed."""
    if w.memory[_IS_STIFF] > 0.0:
        if new_point:
            _jacobian(p, w, x, t, h)
        _implicit(p, w, x, t, h)
        return float(_size(p, w, x, tolerance))
    rate = _explicit(p, w, x, t, h)
    w.memory[_AT_BOUND] = w.memory[_AT_BOUND] + 1.0 if rate > _STIFF else 0.0
    if w.memory[_AT_BOUND] >= _STIFF_STEPS:
        w.memory[_IS_STIFF] = 1.0
    return float(_size(p, w, x, tolerance))


@in_place(inline="always")
def _next_step(w: Work, error: float, h: float) -> None:
    """Remember the step that the error allows; one that was cut short leaves a longer one as it was."""
    power = -1.0 / 3.0 if w.memory[_IS_STIFF] > 0.0 else -0.2
    if not np.isfinite(error):
        w.memory[_STEP] = 0.25 * h
    elif error > 1.0:
        w.memory[_STEP] = h * max(0.2, 0.9 * error**power)
    else:
        grown = h * (5.0 if error < 1e-9 else min(5.0, 0.9 * error**power))
        w.memory[_STEP] = grown if grown < h else max(w.memory[_STEP], grown)


@in_place(inline="always")
def _advance(p: Tape, w: Work, x: FloatArray, t: float, end: float, span: float, tolerance: float) -> int:
    """Carry x from t to end, in place; span is the time between rows. Returns why it ended."""
    if p.switches.size > 0:
        _settle(p, w, x, t)
    else:
        w.memory[_ROW] = 0.0
        _field_in_row(p, w, x, t)
    new_point = True
    locating, low, high = False, 0.0, 0.0  # while a crossing is located: a step before it and one beyond it
    side, slow, width = 0, 0, 0.0  # where the last one tried lay, how often the bracket did not halve, and from what
    close = _LOCATED * span
    while end - t > 1e-12 * span:
        h = min(w.memory[_STEP], end - t) if w.memory[_STEP] > 0.0 else end - t
        if end - t - h < 0.1 * h:
            h = end - t
        if locating:
            h = _located(w, low, high, close, side, slow >= 2) if high - low > close else high
            slow = 0 if slow >= 2 else slow
        w.memory[_STEPS] += 1.0
        if w.memory[_STEPS] > MOST_STEPS:
            return TOO_MANY_STEPS
        error = _trial(p, w, x, t, h, tolerance, new_point)
        new_point = False
        switched = p.switches.size > 0 and w.memory[_CROSSINGS] < MOST_CROSSINGS
        crossed = switched and (error <= 1.0 or np.isnan(error)) and _crossing(p, w)
        if not error <= 1.0 and not crossed:
            _next_step(w, error, h)
            locating = False
            if w.memory[_STEP] < 1e-13 * span:
                return NOT_A_NUMBER
            continue
        if switched:
            if crossed and not locating:
                low, high, locating, side, slow = 0.0, h, True, 0, 0
                if high - low > close:
                    _begin_locating(p, w, x, t)
                    continue
            elif locating and h < high:
                # false position with Illinois' remedy: the end that stays counts half
                width = high - low
                if crossed:
                    high = h
                    _copy(w.over, w.beyond)
                    if side == 1:
                        _halve(w.before)
                else:
                    low = h
                    _copy(w.over, w.before)
                    if side == -1:
                        _halve(w.beyond)
                side = 1 if crossed else -1
                slow = slow + 1 if high - low > 0.5 * width else 0
                if not crossed or high - low > close:
                    continue
        t += h
        for i in range(p.n):
            x[i], w.K[0, i] = w.y[i], w.K[6, i]
            w.seen[i] = max(w.seen[i], abs(x[i]))
            if not abs(x[i]) < _LARGEST:
                return NOT_A_NUMBER
        new_point = True
        if locating:
            w.memory[_CROSSINGS] += 1.0
        else:
            _next_step(w, error, h)
        if locating or (p.switches.size > 0 and w.memory[_CROSSINGS] >= MOST_CROSSINGS):
            locating = False
            _settle(p, w, x, t)
    return DONE


@in_place(inline="always")
def _inputs(
    p: Tape, w: Work, times: FloatArray, columns: FloatArray, delays: FloatArray, at: IntArray, now: float, close: float
) -> float:
    """Bring every input's row up to now, and return when the next one changes."""
    following = np.inf
    last = times.size - 1
    w.since[0] = now - times[0]
    for j in range(p.linear.size):
        while at[j] < last and times[at[j] + 1] + delays[j] <= now + close:
            at[j] += 1
        k = at[j]
        w.base[j], w.ramp[j] = columns[k, j], 0.0
        if k < last:
            following = min(following, times[k + 1] + delays[j])
            begun = now - (times[k] + delays[j])
            if p.linear[j] and begun > -close:
                w.ramp[j] = (columns[k + 1, j] - columns[k, j]) / (times[k + 1] - times[k])
                w.base[j] += w.ramp[j] * begun
            elif p.linear[j]:  # the delayed column has not begun: its first value holds
                following = min(following, times[k] + delays[j])
    return following


@in_place(inline="always")
def _to_next_row(
    p: Tape, w: Work, x: FloatArray, times: FloatArray, columns: FloatArray, delays: FloatArray, at: IntArray,
    row: int, close: float, tolerance: float,
) -> tuple[int, float]:  # fmt: skip
    """Carry x from a row to the next through all changes of inputs; returns why it ended and when."""
    t, following = times[row], times[row + 1]
    span = following - t
    w.memory[_STEPS], w.memory[_CROSSINGS] = 0.0, 0.0
    while following - t > close:
        change = _inputs(p, w, times, columns, delays, at, t, close)
        end = following if change > following - close else change
        ended = _advance(p, w, x, t - times[0], end - times[0], span, tolerance)
        if ended != DONE:
            return ended, t
        w.memory[_ROW] = 0.0
        _field_in_row(p, w, x, end - times[0])
        t = end
    return DONE, following


@in_place
def _begin(p: Tape, w: Work, x0: FloatArray, number: int, x: FloatArray) -> None:
    """Bring the state to a row of ``x0``, with nothing known yet of steps and switches."""
    for i in range(p.n):
        x[i] = x0[number, i]
        w.seen[i] = abs(x[i])
    for k in range(p.switches.size):
        w.sliding[k] = w.crossed[k] = 0
        w.zero[k] = w.largest[k] = 0.0
    for i in range(w.memory.size):
        w.memory[i] = 0.0


@in_place
def _row_before(times: FloatArray, t: float) -> int:
    """Return the last row that comes before a time, -1 where there is none."""
    low, high = 0, times.size
    while low < high:
        middle = (low + high) // 2
        if times[middle] < t:
            low = middle + 1
        else:
            high = middle
    return low - 1


@in_place
def _integrate(
    p: Tape, w: Work, times: FloatArray, columns: FloatArray, delays: FloatArray, start: int, stop: int, x0: FloatArray,
    tolerance: float, most: float, out: FloatArray, ends: FloatArray, status: FloatArray, window: int, x: FloatArray,
    at: IntArray,
) -> None:  # fmt: skip
    """Integrate one window; ``x`` and ``at`` are room for the state and for every input's row."""
    close = 1e-9 * (times[-1] - times[0]) / max(times.size - 1, 1)
    _begin(p, w, x0, window, x)
    t = times[start]
    for j in range(p.linear.size):
        at[j] = max(_row_before(times, t - delays[j] - close), 0)
    # a row's reading sees the inputs as they were before its command acts
    _inputs(p, w, times, columns, delays, at, t - 3.0 * close, close)
    _settle(p, w, x, t - times[0])
    status[window, 0], status[window, 1] = DONE, t
    spare = most * SPARE_ROWS
    for row in range(start, stop):
        evaluate(p.code, p.dynamic, p.code.shape[0], w.r, False)
        for q in range(p.outputs.size):
            out[q, row] = w.r[p.outputs[q]]
        if row + 1 >= times.size:
            break
        ended, t = _to_next_row(p, w, x, times, columns, delays, at, row, close, tolerance)
        status[window, 2] += w.memory[_STEPS]
        spare += most - w.memory[_STEPS]
        if ended == DONE and spare < 0.0:
            ended = TOO_MANY_STEPS
        if ended != DONE:
            status[window, 0], status[window, 1] = ended, t
            break
    for i in range(p.n):
        ends[window, i] = x[i]


@njit(**COMPILED)
def run(
    p: Tape, template: FloatArray, parameters: FloatArray, times: FloatArray, columns: FloatArray, delays: FloatArray,
    starts: IntArray, stops: IntArray, x0: FloatArray, tolerance: float, most: float, out: FloatArray,
    ends: FloatArray, status: FloatArray,
) -> None:  # fmt: skip
    """Integrate every window and write outputs at its rows, its end state, and how it ended.

    ``most`` bounds the steps between two rows on average. ``out`` is (q, N); ``ends`` (W, n) receives the state at each
    window's stop row (or at the last row); ``status`` (W, 3) the reason and the time of the end, and the steps taken.
    """
    w = _work(p, template, parameters)
    x, at = np.zeros(p.n), np.zeros(p.linear.size, dtype=np.int64)
    for window in range(starts.size):
        _integrate(
            p, w, times, columns, delays, starts[window], stops[window], x0, tolerance, most, out, ends, status, window,
            x, at,
        )  # fmt: skip


@njit(**COMPILED)
def look(
    p: Tape, template: FloatArray, parameters: FloatArray, states: FloatArray, inputs: FloatArray, t: float
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives (P, n) and outputs (P, q) at P points of states (P, n) and inputs (P, m) at time t."""
    w = _work(p, template, parameters)
    points = states.shape[0]
    found, y, x = np.zeros((points, p.n)), np.zeros((points, p.outputs.size)), np.zeros(p.n)
    for i in range(points):
        _begin(p, w, states, i, x)
        for j in range(p.linear.size):
            w.base[j] = inputs[i, j]
        _settle(p, w, x, t)
        evaluate(p.code, p.dynamic, p.code.shape[0], w.r, False)
        for j in range(p.n):
            found[i, j] = w.K[0, j]
        for q in range(p.outputs.size):
            y[i, q] = w.r[p.outputs[q]]
    return found, y
