"""The stages of the compiled simulation as they are without any effect.

:mod:`autotune.diagnosis.simulation.compiled` writes each of them anew with the lines that effects have there; types and
order of the arguments are those of :data:`autotune.effects.stages.STAGES`.
"""

from __future__ import annotations

import math  # noqa: F401 - what is written anew uses it
from typing import NamedTuple

from numba import njit

from autotune.arrays import FloatArray, IntArray

#: For what runs in every step and allocates nothing: counting references to its arrays took nine tenths of the time.
inlined = njit(cache=True, nogil=True, forceinline=True, _nrt=False)


class Effects(NamedTuple):
    """Numbers of the run and of the effects' parameters, which effects act, and what they remember."""

    numbers: FloatArray
    acts: IntArray
    memory: FloatArray


#: How many numbers effects remember.
MEMORIES = 0


@inlined
def begin(w: float, follows: bool, carried: FloatArray, effects: Effects) -> None:
    """Set what effects remember where a window begins; ``follows`` says whether it goes on where another ended."""


@inlined
def clock(elapsed: float, effects: Effects) -> float:
    """Return when a command acts, counted from the first row."""
    return elapsed


@inlined
def converter(u: float, t: float, effects: Effects) -> float:
    """Return the absolute command."""
    return u


@inlined
def command(w: float, offset: float, dt: float, t: float, number: int, effects: Effects) -> float:
    """Return what the first block receives."""
    return w


@inlined
def load(t: float, number: int, effects: Effects) -> float:
    """Return the environment's force at the plant's input."""
    return 0.0


@inlined
def force(w: float, v: float, x: float, level: float, t: float, number: int, effects: Effects) -> float:
    """Return the state-dependent force at the plant's input, in that input's unit."""
    return 0.0


@inlined
def travel(dx: float, dt: float, effects: Effects) -> None:
    """Remember a travel of the position."""


@inlined
def friction(v: float, effects: Effects) -> float:
    """Return the level of dry friction at a speed."""
    return 0.0


@inlined
def outflow(x: float, level: float, effects: Effects) -> float:
    """Return what is added at the input of the plant's last block."""
    return 0.0


@inlined
def stop(x: float, v: float, effects: Effects) -> tuple[float, float]:
    """Return position and speed after a sub-step."""
    return x, v


@inlined
def sensor(z: float, t: float, through: float, effects: Effects) -> float:
    """Return the last block's output."""
    return z


@inlined
def reading(y: float, t: float, effects: Effects) -> float:
    """Return the absolute reading."""
    return y
