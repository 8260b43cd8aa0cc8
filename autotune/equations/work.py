"""What an integration reads, the arrays of a tape, and what it writes on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from autotune.arrays import FloatArray, IntArray
from autotune.equations.in_place import COMPILED, in_place
from autotune.equations.tape_ops import evaluate

#: Places in the memory of a run: the last step [s], whether it is stiff, steps and crossings since the last row,
#: successive steps at the stability bound, the row of K that is filled (an argument that is written as a number would
#: have the function compiled once for every such number).
STEP, IS_STIFF, STEPS, CROSSINGS, AT_BOUND, ROW = 0, 1, 2, 3, 4, 5


class Tape(NamedTuple):
    """A program's arrays, see :class:`autotune.equations.tape.Program`; n states; the address of machine code, or 0."""

    code: IntArray
    still: int
    dynamic: int
    slopes: IntArray
    outputs: IntArray
    switches: IntArray
    modes: IntArray
    ties: IntArray
    linear: IntArray
    speeds: IntArray
    n: int
    native: int


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
def new_work(p: Tape, template: FloatArray, parameters: FloatArray) -> Work:
    """Return room for an integration, with everything that depends on parameters alone computed.

    Parameters
    ----------
    p : Tape
        The program.
    template : array
        Registers with the program's constants.
    parameters : (P,) array
        In their own units.
    """
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


@in_place
def begin(p: Tape, w: Work, x0: FloatArray, number: int, x: FloatArray) -> None:
    """Bring the state to a row of ``x0``, with nothing known yet of steps and switches.

    Parameters
    ----------
    p : Tape
        The program, n states.
    w : Work
        What is written on.
    x0 : (W, n) array
        Start states.
    number : int
        Row of them.
    x : (n,) array
        The state, changed in place.
    """
    for i in range(p.n):
        x[i] = x0[number, i]
        w.seen[i] = abs(x[i])
    for k in range(p.switches.size):
        w.sliding[k] = w.crossed[k] = 0
        w.zero[k] = w.largest[k] = 0.0
    for i in range(w.memory.size):
        w.memory[i] = 0.0


@in_place
def copy(a: FloatArray, b: FloatArray) -> None:
    """Write one array's values into another.

    Parameters
    ----------
    a, b : array
        From, and to; of one length.
    """
    for i in range(a.size):
        b[i] = a[i]


@in_place
def halve(a: FloatArray) -> None:
    """Halve every value in place."""
    for i in range(a.size):
        a[i] *= 0.5
