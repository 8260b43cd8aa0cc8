"""Start states: rest under the first command at the first reading, then what fits a window's readings best."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.equations.rest import rest_state, state_scales, stated_starts
from autotune.equations.sensitivity import STEP, Windows, run_windows, sensitivities
from autotune.equations.simulate import Compiled, Drive, Run

#: Rows that a start state is fitted to at least; where those run away, to a part of them first, this many at least.
LEAST, LEAST_WINDOW = 30, 4
#: Parts of a window in which its state is found anew, one after the other, where a simulation ends with this many times
#: the error that it begins with.
HOPS, STRAYS = 8, 2.0
#: Shares of its rows that a window started anew is fitted to, one after the other: wrong numbers lead the rest astray;
#: and steps of each.
ANEW, ANEW_STEPS = (0.1, 0.3, 1.0), 4


def fit_starts(
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
        numbers are worth following, so that others begin where the readings lead, see :meth:`_Readings.follow_state`.

    Returns
    -------
    Windows
        With their states.
    """
    given, first = stated_starts(compiled), int(starts[0])
    reading = float(y[first:][good[first:]][0]) if good[first:].any() else float("nan")
    x = rest_state(compiled, parameters, drive.inputs[max(first - 1, 0)], reading) if guess is None else guess
    scales = state_scales(compiled, parameters, drive, x)
    at = _Readings(compiled=compiled, parameters=parameters, drive=drive, y=y, good=good, scales=scales)
    found = []
    for k, (a, b) in enumerate(zip(starts, stops, strict=True)):
        until = _until(a, b, share, least)
        window = Windows(starts=np.array([a]), stops=np.array([until]), states=x[None, :])
        taken = None if known is None else at.state_at(known, int(a))
        if taken is not None:
            window = replace(window, states=taken[None, :])
        elif k and at.is_lost(window):
            # what runs away ends far from the readings: the window begins at rest at its own first one
            ahead = y[a:until][good[a:until]]
            at_rest = rest_state(compiled, parameters, drive.inputs[a - 1], float(ahead[0]) if ahead.size else np.nan)
            window = replace(window, states=at_rest[None, :])
        for end in at.ends(window) if taken is None else ():
            window = at.fitted(replace(window, stops=np.array([end])), _free(given, a), iterations)
        found.append(window.states[0])
        if k + 1 < starts.size:
            whole = replace(window, stops=np.array([b]))
            run = at.run(whole)
            x = run.ends[0] if np.all(np.isfinite(run.ends)) else x
            if known is not None and at.strays(run.y, whole):
                x = at.follow_state(whole, iterations)
    return Windows(starts=starts, stops=stops, states=np.array(found))


def restart_some(
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
    w, states, given = windows, windows.states.copy(), stated_starts(compiled)
    at = _Readings(compiled=compiled, parameters=parameters, drive=drive, y=y, good=good, scales=scales)
    for k in which:
        start, stop = int(w.starts[k]), int(w.stops[k])
        one = Windows(starts=w.starts[k : k + 1], stops=w.stops[k : k + 1], states=states[k : k + 1].copy())
        if k and w.stops[k - 1] == start:
            before = Windows(starts=w.starts[k - 1 : k], stops=one.starts, states=states[k - 1 : k])
            ends = at.run(before).ends
            one = replace(one, states=ends) if np.all(np.isfinite(ends)) else one
        for share in ANEW:
            one = replace(one, stops=np.array([_until(start, stop, share, LEAST)]))
            one = at.fitted(one, _free(given, start), ANEW_STEPS)
        states[k] = one.states[0]
    return replace(w, states=states)


def _free(given: FloatArray, start: int) -> IntArray:
    """Return which states of a window's start are sought: at a recording's beginning those that are not given."""
    return np.flatnonzero(~np.isfinite(given)) if start == 0 else np.arange(given.size)


def _until(start: int, stop: int, share: float, least: int) -> int:
    """Return the end of the share of a window's rows that its start is fitted to, some rows at least."""
    return min(max(int(start + share * (stop - start)), start + least), stop)


def _hop(window: Windows) -> int:
    return max(int(window.stops[0] - window.starts[0]) // HOPS, LEAST)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Readings:
    """Readings of a recording, which of them count, and the model that runs beside them with its states' sizes (n,)."""

    compiled: Compiled
    parameters: FloatArray
    drive: Drive
    y: FloatArray
    good: BoolArray
    scales: FloatArray

    def run(self, window: Windows) -> Run:
        """Simulate windows."""
        return run_windows(self.compiled, self.parameters, self.drive, window)

    def state_at(self, known: Windows, row: int) -> FloatArray | None:
        """Return the state at a row within known windows; nothing elsewhere, or where the simulation runs away."""
        inside = np.flatnonzero((known.starts <= row) & (row < known.stops))
        if inside.size == 0:
            return None
        k = inside[-1:]
        run = self.run(Windows(starts=known.starts[k], stops=np.array([row]), states=known.states[k]))
        x = known.states[k[0]] if known.starts[k[0]] == row else run.ends[0]
        return np.array(x) if np.all(np.isfinite(x)) else None

    def strays(self, simulated: FloatArray, window: Windows) -> bool:
        """Whether a simulation ends much further from the readings than it begins, or does not reach its end."""
        a, b, hop = int(window.starts[0]), int(window.stops[0]), _hop(window)
        error = np.where(self.good[a:b], self.y[a:b] - simulated[a:b], 0.0) ** 2
        return not float(np.mean(error[-hop:])) <= STRAYS**2 * float(np.mean(error[:hop]))

    def follow_state(self, window: Windows, iterations: int) -> FloatArray:
        """Return the state at a window's end, found anew from the readings part by part.

        A simulation that strays ends on another swing than the readings, and the next window would begin there.
        """
        b, hop, x = int(window.stops[0]), _hop(window), window.states[0]
        for row in range(int(window.starts[0]), b, hop):
            one = Windows(starts=np.array([row]), stops=np.array([min(row + hop, b)]), states=x[None, :])
            if row > window.starts[0]:
                one = self.fitted(one, np.arange(x.size), iterations)
            ends = self.run(one).ends[0]
            x = ends if np.all(np.isfinite(ends)) else x
        return np.array(x)

    def ends(self, window: Windows) -> list[int]:
        """Return where to fit a start up to in turn: a first part that does not run away, twice that, all."""
        first, ends = int(window.starts[0]), [int(window.stops[0])]
        while ends[0] - first > LEAST_WINDOW and not self.run(replace(window, stops=np.array(ends[:1]))).is_complete:
            ends.insert(0, first + (ends[0] - first) // 2)
        return ends

    def is_lost(self, window: Windows) -> bool:
        """Whether a window's simulation leaves the readings by more than these have moved altogether."""
        rows = np.flatnonzero(self.good[window.starts[0] : window.stops[0]]) + int(window.starts[0])
        off = np.abs(self.y[rows] - self.run(window).y[rows])
        return bool(rows.size and not np.all(off < np.ptp(self.y[self.good])))

    def fitted(self, window: Windows, free: IntArray, iterations: int) -> Windows:
        """Return one window with the start state that fits its readings; what they do not tell stays as it was."""
        if free.size == 0:
            return window
        a, b, scales = int(window.starts[0]), int(window.stops[0]), self.scales
        rows, damping = np.flatnonzero(self.good[a:b]) + a, 1e-6
        r = self.y[rows] - self.run(window).y[rows]
        for _ in range(iterations):
            s = sensitivities(
                self.compiled, self.parameters, self.drive, window, parameter_steps=np.ones(self.parameters.size),
                state_steps=STEP * scales, which=(), which_states=free.tolist(),
            )  # fmt: skip
            J = s.to_states[rows][:, free] * scales[free]
            if not np.all(np.isfinite(J)) or not np.all(np.isfinite(r)):
                return window
            H = J.T @ J
            H += np.diag(damping * np.diag(H) + 1e-9 * float(np.trace(H)) + 1e-300)
            states = window.states.copy()
            states[0, free] += scales[free] * np.linalg.solve(H, J.T @ r)
            moved = replace(window, states=states)
            new = self.y[rows] - self.run(moved).y[rows]
            if not np.all(np.isfinite(new)) or new @ new > r @ r:
                damping = max(damping, 1e-6) * 100.0
                if damping > 1e6:
                    break
                continue
            small = r @ r - new @ new < 1e-6 * (r @ r)
            window, r = moved, new
            if small:
                break
        return window
