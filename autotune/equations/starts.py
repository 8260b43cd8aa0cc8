"""Start states: rest under the first command at the first reading, then what fits a window's readings best."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.equations.sensitivity import STEP, Windows, sensitivities
from autotune.equations.simulate import Compiled, Drive, derivatives, simulate

#: Rows that a start state is fitted to at least; where those run away, to a part of them first, this many at least.
LEAST, LEAST_WINDOW = 30, 4
#: Parts of a window in which its state is found anew, one after the other, where a simulation ends with this many times
#: the error that it begins with.
HOPS, STRAYS = 8, 2.0
#: Shares of its rows that a window started anew is fitted to, one after the other: wrong numbers lead the rest astray;
#: and steps of each.
ANEW, ANEW_STEPS = (0.1, 0.3, 1.0), 4


def given_starts(compiled: Compiled) -> FloatArray:
    """Return the start value that the file states for each state, NaN where it is to be estimated, shape (n,)."""
    known = {one.name: one.start for one in compiled.model.states}
    values = [known.get(name) for name in compiled.states]
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def rest_state(compiled: Compiled, parameters: FloatArray, inputs: FloatArray, y: float) -> FloatArray:
    """Return the state nearest to rest that reads y under inputs.

    Parameters
    ----------
    compiled, parameters
        The model.
    inputs : (m,) array
        What drives it.
    y : float
        The reading; NaN leaves it out.

    Returns
    -------
    (n,) array
        States that the file gives a start are left there.

    Notes
    -----
    Least squares from a few starts; of several rests (a pendulum hangs or stands) the one nearest to zero is found.
    """
    given = given_starts(compiled)
    free = np.flatnonzero(~np.isfinite(given))
    base = np.where(np.isfinite(given), given, 0.0)
    if free.size == 0:
        return base
    u = inputs[None, :]

    def point(z: FloatArray) -> FloatArray:
        x = base.copy()
        x[free] = z
        return x

    def misses(z: FloatArray) -> FloatArray:
        x = point(z)
        slopes, outputs = derivatives(compiled, parameters, x[None, :], u)
        off = outputs[0, 0] - y if np.isfinite(y) else 0.0
        found = np.append(slopes[0], 1e3 * off)
        return np.where(np.isfinite(found), np.clip(found, -1e12, 1e12), 1e12)

    tries = [base[free], base[free] + (y if np.isfinite(y) else 1.0), base[free] + 1.0]
    results = [least_squares(misses, z, x_scale=np.maximum(np.abs(z), 1.0), max_nfev=60) for z in tries]
    best = min(results, key=lambda result: (round(float(np.log10(result.cost + 1e-12)), 1), float(result.x @ result.x)))
    return point(np.asarray(best.x, dtype=np.float64))


def state_scales(compiled: Compiled, parameters: FloatArray, drive: Drive, start: FloatArray) -> FloatArray:
    """Return how large each state typically is: what a change of it is measured by.

    Parameters
    ----------
    compiled : Compiled
        n states.
    parameters : (P,) array
        In their own units.
    drive : Drive
        The recording's inputs.
    start : (n,) array
        State at the first row.

    Returns
    -------
    (n,) array
        Sizes, in the states' units.
    """
    probe = np.linspace(0, drive.t.size - 1, min(drive.t.size, 400)).astype(np.int64)[:-1]
    states = np.repeat(start[None, :], probe.size, axis=0)
    run = simulate(compiled, parameters, drive, states, starts=probe, stops=probe + 1)
    ends = run.ends[np.all(np.isfinite(run.ends), axis=1)]
    whole = simulate(compiled, parameters, drive, start[None, :])
    sizes = [np.abs(start), np.abs(whole.ends[0]) if whole.is_complete else np.zeros(start.size)]
    if ends.size:
        slopes = np.max(np.abs(ends - start), axis=0) / float(np.median(np.diff(drive.t)))
        sizes.append(np.minimum(slopes, 1e6))
    size = np.nanmax(np.array(sizes), axis=0)
    return np.where(size > 1e-9, size, 1.0)


def fitted_starts(
    compiled: Compiled,
    parameters: FloatArray,
    drive: Drive,
    y: FloatArray,
    good: BoolArray,
    starts: IntArray,
    stops: IntArray,
    *,
    guess: FloatArray | None = None,
    iterations: int = 8,
    share: float = 0.1,
    least: int = LEAST,
    known: Windows | None = None,
) -> Windows:
    """Find each window's start state: the previous window's end, then what fits its readings.

    Parameters
    ----------
    compiled, parameters, drive
        The model and what drives it.
    y, good : (N,) arrays
        Readings, and which of them count.
    starts, stops : (W,) int arrays
        The windows.
    guess : (n,) array, optional
        State to begin the first window from; rest by default.
    iterations : int
        Gauss-Newton steps per window.
    share : float
        Share of a window's rows that its start is fitted to: wrong parameters lead the rest astray.
    least : int
        Rows that it is fitted to at least.
    known : Windows, optional
        Where an earlier fit knows the state, on its own windows: a window that starts within one takes it over. Its
        numbers are worth following, so that others begin where the readings lead, see :func:`_followed`.

    Returns
    -------
    Windows
        With their states.
    """
    given = given_starts(compiled)
    first = int(starts[0])
    reading = float(y[first:][good[first:]][0]) if good[first:].any() else float("nan")
    x = rest_state(compiled, parameters, drive.inputs[max(first - 1, 0)], reading) if guess is None else guess
    scales = state_scales(compiled, parameters, drive, x)
    found = []
    for k, (a, b) in enumerate(zip(starts, stops, strict=True)):
        free = _free(given, a)
        until = _until(a, b, share, least)
        window = Windows(starts=np.array([a]), stops=np.array([until]), states=x[None, :])
        taken = None if known is None else _state_at(compiled, parameters, drive, known, int(a))
        if taken is not None:
            window = replace(window, states=taken[None, :])
        elif k and _is_lost(compiled, parameters, drive, y, good, window):
            # what runs away ends far from the readings: the window begins at rest at its own first one
            ahead = y[a:until][good[a:until]]
            at_rest = rest_state(compiled, parameters, drive.inputs[a - 1], float(ahead[0]) if ahead.size else np.nan)
            window = replace(window, states=at_rest[None, :])
        for end in _ends(compiled, parameters, drive, window) if taken is None else ():
            window = replace(window, stops=np.array([end]))
            window = _fitted(compiled, parameters, drive, y, good, window, scales, free, iterations)
        found.append(window.states[0])
        if k + 1 < starts.size:
            whole = replace(window, stops=np.array([b]))
            run = simulate(compiled, parameters, drive, whole.states, starts=whole.starts, stops=whole.stops)
            x = run.ends[0] if np.all(np.isfinite(run.ends)) else x
            if known is not None and _strays(run.y, y, good, whole):
                x = _followed(compiled, parameters, drive, y, good, whole, scales, iterations)
    return Windows(starts=starts, stops=stops, states=np.array(found))


def _state_at(
    compiled: Compiled, parameters: FloatArray, drive: Drive, known: Windows, row: int
) -> FloatArray | None:  # fmt: skip
    """Return the state at a row within known windows; nothing elsewhere, or where the simulation runs away."""
    inside = np.flatnonzero((known.starts <= row) & (row < known.stops))
    if inside.size == 0:
        return None
    k = inside[-1:]
    run = simulate(compiled, parameters, drive, known.states[k], starts=known.starts[k], stops=np.array([row]))
    x = known.states[k[0]] if known.starts[k[0]] == row else run.ends[0]
    return np.array(x) if np.all(np.isfinite(x)) else None


def _hop(window: Windows) -> int:
    return max(int(window.stops[0] - window.starts[0]) // HOPS, LEAST)


def _strays(simulated: FloatArray, y: FloatArray, good: BoolArray, window: Windows) -> bool:
    """Whether a simulation ends much further from the readings than it begins, or does not reach its end."""
    a, b, hop = int(window.starts[0]), int(window.stops[0]), _hop(window)
    error = np.where(good[a:b], y[a:b] - simulated[a:b], 0.0) ** 2
    return not float(np.mean(error[-hop:])) <= STRAYS**2 * float(np.mean(error[:hop]))


def _followed(
    compiled: Compiled, parameters: FloatArray, drive: Drive, y: FloatArray, good: BoolArray, window: Windows,
    scales: FloatArray, iterations: int,
) -> FloatArray:  # fmt: skip
    """Return the state at a window's end, found anew from the readings part by part.

    A simulation that strays ends on another swing than the readings, and the next window would begin there.
    """
    b, hop, x = int(window.stops[0]), _hop(window), window.states[0]
    for at in range(int(window.starts[0]), b, hop):
        one = Windows(starts=np.array([at]), stops=np.array([min(at + hop, b)]), states=x[None, :])
        if at > window.starts[0]:
            one = _fitted(compiled, parameters, drive, y, good, one, scales, np.arange(x.size), iterations)
        ends = simulate(compiled, parameters, drive, one.states, starts=one.starts, stops=one.stops).ends[0]
        x = ends if np.all(np.isfinite(ends)) else x
    return np.array(x)


def started_anew(
    compiled: Compiled, parameters: FloatArray, drive: Drive, y: FloatArray, good: BoolArray, windows: Windows,
    which: IntArray, scales: FloatArray,
) -> Windows:  # fmt: skip
    """Return windows, some of them started anew: from where the one before them ends, or from where they start.

    Parameters
    ----------
    compiled, parameters, drive
        The model and what drives it.
    y, good : (N,) arrays
        Readings, and which of them count.
    windows : Windows
        Of one recording.
    which : int array
        Those to be started anew; each is fitted to growing shares of its rows.
    scales : (n,) array
        How large each state typically is.
    """
    w, states, given = windows, windows.states.copy(), given_starts(compiled)
    for k in which:
        start, stop = int(w.starts[k]), int(w.stops[k])
        one = Windows(starts=w.starts[k : k + 1], stops=w.stops[k : k + 1], states=states[k : k + 1].copy())
        if k and w.stops[k - 1] == start:
            before = simulate(
                compiled, parameters, drive, states[k - 1 : k], starts=w.starts[k - 1 : k], stops=one.starts
            )
            one = replace(one, states=before.ends) if np.all(np.isfinite(before.ends)) else one
        for share in ANEW:
            one = replace(one, stops=np.array([_until(start, stop, share, LEAST)]))
            one = _fitted(compiled, parameters, drive, y, good, one, scales, _free(given, start), ANEW_STEPS)
        states[k] = one.states[0]
    return replace(w, states=states)


def _free(given: FloatArray, start: int) -> IntArray:
    """Return which states of a window's start are sought: at a recording's beginning those that are not given."""
    return np.flatnonzero(~np.isfinite(given)) if start == 0 else np.arange(given.size)


def _until(start: int, stop: int, share: float, least: int) -> int:
    """Return the end of the share of a window's rows that its start is fitted to, some rows at least."""
    return min(max(int(start + share * (stop - start)), start + least), stop)


def _ends(compiled: Compiled, parameters: FloatArray, drive: Drive, window: Windows) -> list[int]:
    """Return where to fit a start up to, one after the other: a first part that does not run away, twice that, all."""
    first, ends = int(window.starts[0]), [int(window.stops[0])]
    while ends[0] - first > LEAST_WINDOW:
        run = simulate(compiled, parameters, drive, window.states, starts=window.starts, stops=np.array(ends[:1]))
        if run.is_complete:
            break
        ends.insert(0, first + (ends[0] - first) // 2)
    return ends


def _is_lost(
    compiled: Compiled, parameters: FloatArray, drive: Drive, y: FloatArray, good: BoolArray, window: Windows
) -> bool:
    """Whether a window's simulation leaves the readings by more than these have moved altogether."""
    rows = np.flatnonzero(good[window.starts[0] : window.stops[0]]) + int(window.starts[0])
    run = simulate(compiled, parameters, drive, window.states, starts=window.starts, stops=window.stops)
    off = np.abs(y[rows] - run.y[rows])
    return bool(rows.size and not np.all(off < np.ptp(y[good])))


def _fitted(
    compiled: Compiled, parameters: FloatArray, drive: Drive, y: FloatArray, good: BoolArray, window: Windows,
    scales: FloatArray, free: IntArray, iterations: int,
) -> Windows:  # fmt: skip
    """Return one window with the start state that fits its readings; what they do not tell stays as it was."""
    if free.size == 0:
        return window
    a, b = int(window.starts[0]), int(window.stops[0])
    rows = np.flatnonzero(good[a:b]) + a
    no_steps = np.ones(parameters.size)
    damping = 1e-6

    def left(states: FloatArray) -> FloatArray:
        run = simulate(compiled, parameters, drive, states, starts=window.starts, stops=window.stops)
        return np.asarray(y[rows] - run.y[rows])

    r = left(window.states)
    for _ in range(iterations):
        s = sensitivities(
            compiled, parameters, drive, window, parameter_steps=no_steps, state_steps=STEP * scales, which=(),
            which_states=free.tolist(),
        )  # fmt: skip
        J = s.to_states[rows][:, free] * scales[free]
        if not np.all(np.isfinite(J)) or not np.all(np.isfinite(r)):
            return window
        H = J.T @ J
        H += np.diag(damping * np.diag(H) + 1e-9 * float(np.trace(H)) + 1e-300)
        states = window.states.copy()
        states[0, free] += scales[free] * np.linalg.solve(H, J.T @ r)
        new = left(states)
        if not np.all(np.isfinite(new)) or new @ new > r @ r:
            damping = max(damping, 1e-6) * 100.0
            if damping > 1e6:
                break
            continue
        small = r @ r - new @ new < 1e-6 * (r @ r)
        window, r = Windows(starts=window.starts, stops=window.stops, states=states), new
        if small:
            break
    return window
