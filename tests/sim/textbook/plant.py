"""What a plant of a textbook is: its equations in Python, the model file that a person would write, its excitation."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Numbers: TypeAlias = Mapping[str, float]
#: dx/dt of time [s], states, inputs as they arrive, what acts at each place beside the model, and the numbers.
Slopes: TypeAlias = Callable[[float, Sequence[float], Sequence[float], Sequence[float], Numbers], list[float]]
#: A command from the row's number, the reading, and a memory that the law may write to.
Law: TypeAlias = Callable[[int, float, dict[str, float]], float]


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where a force, torque, flow or heat may act.

    Attributes
    ----------
    key, name : str
        ``state`` or ``port`` of the model file, and its name.
    speed, position : callable of the states
        The speed, level or temperature that an effect there depends on, and the position that goes with it.
    inertia : float
        What turns an acceleration into a force there; 1 where effects act on a derivative.
    """

    key: str
    name: str
    speed: Callable[[Sequence[float]], float]
    position: Callable[[Sequence[float]], float] = lambda x: 0.0
    inertia: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Plant:
    """A plant with its source.

    Attributes
    ----------
    name, source : str
        What it is, and where its equations and numbers are written.
    model : str
        The nominal model file.
    slopes, reading : callable
        The same equations in Python, and the reading from states and inputs.
    places : tuple of Place
        Where effects act inside.
    dt_s, rows : float, int
        Sample time and length of a recording.
    start : tuple of float
        States at the first row.
    noise : float
        Standard deviation of the reading's noise.
    columns : callable
        The inputs' columns from a generator and the number of rows, the command first.
    law : callable, optional
        For a plant that needs feedback: what is added to the command.
    within : (low, high)
        Readings of a rig that works: an effect that drives it out is concealed in a smaller size.
    effects : tuple of (name, place, size)
        What it conceals in turn.
    outside : callable
        Slopes with something that no catalogue has.
    """

    name: str
    source: str
    model: str
    slopes: Slopes
    reading: Callable[[Sequence[float], Sequence[float]], float]
    places: tuple[Place, ...]
    dt_s: float
    start: tuple[float, ...]
    noise: float
    columns: Callable[[np.random.Generator, int], dict[str, Floats]]
    effects: tuple[tuple[str, str, float], ...]
    outside: Slopes
    rows: int = 900
    law: Law | None = None
    within: tuple[float, float] = (-float("inf"), float("inf"))

    @property
    def nominal(self) -> dict[str, float]:
        """The numbers of the model file."""
        return {name: float(one["value"]) for name, one in tomllib.loads(self.model)["parameters"].items()}

    @property
    def retuned(self) -> tuple[str, ...]:
        """The numbers that are not fixed."""
        given = tomllib.loads(self.model)["parameters"]
        return tuple(name for name, one in given.items() if not one.get("fixed", False))


def steps(rng: np.random.Generator, rows: int, shortest: int, longest: int, low: float, high: float) -> Floats:
    """Return a staircase of levels drawn evenly, each held for a number of rows drawn evenly.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of levels and times.
    rows : int
        Length of the signal.
    shortest, longest : int
        Rows that a level is held for.
    low, high : float
        Range of the levels.

    Returns
    -------
    (rows,) array
        The signal.
    """
    found: list[float] = []
    while len(found) < rows:
        found += [float(rng.uniform(low, high))] * int(rng.integers(shortest, longest + 1))
    return np.array(found[:rows])


def wave(rng: np.random.Generator, rows: int, slowest: float, middle: float, size: float) -> Floats:
    """Return a smooth measured input about a middle: five sines.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the phases.
    rows : int
        Length of the signal.
    slowest : float
        Period of the slowest sine, in rows.
    middle, size : float
        Its middle, and the root of the summed squares of the amplitudes.

    Returns
    -------
    (rows,) array
        The signal.
    """
    k, found = np.arange(rows), np.full(rows, middle)
    for harmonic in range(1, 6):
        found += size / np.sqrt(5.0) * np.sin(2.0 * np.pi * harmonic * k / slowest + rng.uniform(0.0, 6.28))
    return found
