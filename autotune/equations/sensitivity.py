"""Sensitivities of a simulation to its parameters and start states, by differences along the same steps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np

from autotune.arrays import FloatArray, IntArray
from autotune.equations.simulate import Compiled, Drive, Run, simulate

#: Relative change of a parameter, and of a state's scale, that a derivative is taken over: a hundred times what the
#: integration's tolerance leaves, and small against any curvature.
STEP = 3e-4
#: Simulations at a time; the kernel runs without the interpreter's lock.
THREADS = 2
#: Rows from which on a thread saves more than it costs.
WORTH_A_THREAD = 500


_A = TypeVar("_A")
_B = TypeVar("_B")


@dataclass(frozen=True, kw_only=True, eq=False)
class Windows:
    """Windows of one recording: first rows, rows before which they end, and the state each starts with (W, n)."""

    starts: IntArray
    stops: IntArray
    states: FloatArray


def run_windows(compiled: Compiled, parameters: FloatArray, drive: Drive, windows: Windows) -> Run:
    """Simulate windows, each from its start state; see :func:`autotune.equations.simulate.simulate`.

    Parameters
    ----------
    compiled : Compiled
        The model.
    parameters : (P,) array
        Its numbers, each in its own unit.
    drive : Drive
        Time stamps and inputs.
    windows : Windows
        Their first and last rows, and the states at the first.
    """
    return simulate(compiled, parameters, drive, windows.states, starts=windows.starts, stops=windows.stops)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sensitivities:
    """Derivatives of a simulation's readings.

    Attributes
    ----------
    to_parameters : (N, P) array
        dy/dp of the parameters asked for.
    to_states : (N, n) array
        dy/dx0 with respect to the start state of the window that a row is in.
    """

    to_parameters: FloatArray
    to_states: FloatArray


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(THREADS, thread_name_prefix="simulation")


def side_by_side(one: Callable[[_A], _B], found: Iterable[_A]) -> Iterator[_B]:
    """Return what a function that simulates makes of each of its arguments, in order, several at a time.

    Parameters
    ----------
    one : callable
        Simulates one argument.
    found : iterable
        The arguments.
    """
    return _pool().map(one, found)


def sensitivities(
    compiled: Compiled,
    parameters: FloatArray,
    drive: Drive,
    windows: Windows,
    *,
    parameter_steps: FloatArray,
    state_steps: FloatArray,
    which: Sequence[int] | None = None,
    which_states: Sequence[int] | None = None,
) -> Sensitivities:
    """Simulate with derivatives.

    Parameters
    ----------
    compiled, parameters, drive
        As for :func:`autotune.equations.simulate.simulate`.
    windows : Windows
        Where it starts, and with which states.
    parameter_steps, state_steps : (P,), (n,) arrays
        Changes over which the derivatives are taken; see ``STEP``.
    which, which_states : sequences of int, optional
        Parameters and states whose derivatives are wanted; the others' columns are zero.

    Returns
    -------
    Sensitivities
        Forward differences: first order in the steps. A run that does not reach its end leaves NaN.
    """
    P, n = parameters.size, windows.states.shape[1]
    wanted_p = range(P) if which is None else which
    wanted_x = range(n) if which_states is None else which_states

    def one(change: tuple[str, int]) -> Run:
        kind, i = change
        p, x = parameters, windows.states
        if kind == "p":
            p = p.copy()
            p[i] += parameter_steps[i]
        elif kind == "x":
            x = x.copy()
            x[:, i] += state_steps[i]
        return simulate(compiled, p, drive, x, starts=windows.starts, stops=windows.stops)

    changes = [("", 0), *(("p", i) for i in wanted_p), *(("x", i) for i in wanted_x)]
    rows = int(np.sum(windows.stops - windows.starts))
    base, *moved = _pool().map(one, changes) if rows > WORTH_A_THREAD else map(one, changes)
    to_p, to_x = np.zeros((drive.t.size, P)), np.zeros((drive.t.size, n))
    for (kind, i), run in zip(changes[1:], moved, strict=True):
        if kind == "p":
            to_p[:, i] = (run.y - base.y) / parameter_steps[i]
        else:
            to_x[:, i] = (run.y - base.y) / state_steps[i]
    return Sensitivities(to_parameters=to_p, to_states=to_x)
