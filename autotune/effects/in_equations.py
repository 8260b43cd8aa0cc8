"""How an effect acts in a model of equations, as a part of its record: in the model's own language, as text.

In the texts ``V`` is the speed, difference or state that the effect acts on, ``X`` the position, level or temperature
that goes with it, ``value`` what would be there without the effect, ``column`` a recorded column, ``t`` the time.
All other names are the effect's parameters and its memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

from autotune.arrays import FloatArray
from autotune.effects.stages import Values

#: ``force``: added to a state's derivative or at a port; ``input``: what the equations receive in place of a column;
#: ``reading``: what is read in place of the output; ``anywhere``: added at any of these; ``held``: done to the held
#: samples of a column; ``delay``: a dead time of a column; ``converter``: done to the samples of the reading;
#: ``nothing``: it lies in recorded samples or in the law alone.
Acts: TypeAlias = Literal["force", "input", "reading", "anywhere", "held", "delay", "converter", "nothing"]
#: Kinds of states and of ports on which what moves, what is stored and what is heated can be acted on.
MOVING, STORED, HEATED = ("speed", "force", "torque"), ("level", "pressure", "flow"), ("temperature", "heat")
#: Where something may push.
LOADED = (*MOVING, "level", "flow", *HEATED)


@dataclass(frozen=True, kw_only=True, eq=False)
class Around:
    """What the recordings show around a place where an effect may act, under a fit without it.

    Attributes
    ----------
    size : float
        How large what acts there typically is: a derivative, a force at a port, the command, the reading.
    v, x : (rows,) array
        State or difference, and the position or level that goes with it; the same one where there is none.
    has_position : bool
        Whether ``x`` is a position of its own.
    is_angle : bool
        Whether ``x`` may be an angle in rad.
    unit, kind : str
        Unit and kind of the state; empty elsewhere.
    per_rate : float
        At a port, the force that changes the state by one unit a second; 1 at a state.
    u, y : (rows,) array
        Command from its operating point on, and reading.
    offset : float
        The operating point.
    dt_s, duration_s, slow_s : float
        Sample time, length of a recording, and the slowest lag that is looked for [s].
    lines : tuple of float
        Frequencies that stand out of the residual [Hz].
    columns : mapping of str to (rows,) arrays
        Recorded columns that the model does not have.
    """

    size: float
    v: FloatArray
    x: FloatArray
    has_position: bool
    is_angle: bool
    unit: str
    kind: str
    per_rate: float
    u: FloatArray
    y: FloatArray
    offset: float
    dt_s: float
    duration_s: float
    slow_s: float
    lines: tuple[float, ...]
    columns: Mapping[str, FloatArray]

    @property
    def force(self) -> float:
        """A size that is tried of what acts there."""
        return 0.05 * self.size

    @property
    def spread(self) -> float:
        """Spread of the command."""
        return float(np.std(self.u)) + 1e-300

    @property
    def largest(self) -> float:
        """How large the state or difference gets."""
        return max(float(np.quantile(np.abs(self.v), 0.9)), 1e-100)

    @property
    def span(self) -> float:
        """What the position moves through."""
        return float(np.ptp(self.x)) + 1e-300


@dataclass(frozen=True)
class Tried:
    """Values that an effect is tried with, which of them are its amplitude, and the column that it takes."""

    values: Values
    scaled: tuple[str, ...] = ()
    column: str = ""


@dataclass(frozen=True, kw_only=True)
class Scales:
    """What numbers of an effect are measured by: spreads of command, reading and column, and what its place does."""

    u: float
    y: float
    duration_s: float
    size: float
    span: float
    column: float


Trials: TypeAlias = Callable[[Around], Iterable[Tried]]


@dataclass(frozen=True, kw_only=True)
class InEquations:
    """How an effect acts in a model of equations.

    Attributes
    ----------
    acts : str
        See :data:`Acts`.
    text : str
        What it adds, or puts in the place of ``value``.
    memory : tuple of (name, derivative)
        States that it brings; names begin with ``memory``.
    follows : bool
        Whether its memory begins at what would be there without the effect; else at 0.
    at_once, unless : str
        The text without memory, which holds unless this parameter is given.
    samples : str
        What is done to held samples, by the effect's first parameter: :mod:`autotune.equations.samples` does it.
    on : tuple of str
        Kinds of states and ports that it may act on.
    trials : callable, optional
        Values to try around a place; by default the record's starting values, or none.
    further : tuple of str
        Parameters that it has here and not in a chain.
    defaults : mapping
        Parameters that may be left out, beside those with a neutral value.
    either_sign : tuple of str
        Parameters that may have either sign here, beside those whose sign is real.
    given : tuple of str
        Parameters that no fit moves.
    held : callable, optional
        Given the parameters' names, those that are not moved as long as only these are given.
    jumps : tuple of str
        Parameters whose change moves nothing or makes a jump: sought from outside the fits.
    spread, least : mapping of str to callable
        Prior standard deviation of a parameter of either sign, and magnitude below which another is not taken.
    usual : bool
        What nearly every machine has, and models leave out: tried beside a large effect whatever others predict.
    free_timing : bool
        Whether it is a load of free timing, which explains a part of everything.
    levels : tuple of str
        Forces between whose values a plant that rests begins to move or not: each piece has a minimum of its own.
    plainer : callable, optional
        Given values, name and values of the effect of fewer numbers that it comes down to in a limit, or nothing.
    is_plainer : callable, optional
        Whether values came to where it is that effect.
    stand_in : callable, optional
        Given values and what the position did, whether it is no longer what its name says.
    """

    acts: Acts
    text: str = ""
    memory: tuple[tuple[str, str], ...] = ()
    follows: bool = False
    at_once: str = ""
    unless: str = ""
    samples: Literal["", "play", "stick", "steps"] = ""
    on: tuple[str, ...] = ()
    trials: Trials | None = None
    further: tuple[str, ...] = ()
    defaults: Values = field(default_factory=dict, hash=False)
    either_sign: tuple[str, ...] = ()
    given: tuple[str, ...] = ()
    held: Callable[[Iterable[str]], tuple[str, ...]] | None = None
    jumps: tuple[str, ...] = ()
    spread: Mapping[str, Callable[[Scales], float]] = field(default_factory=dict, hash=False)
    least: Mapping[str, Callable[[Scales], float]] = field(default_factory=dict, hash=False)
    usual: bool = False
    free_timing: bool = False
    levels: tuple[str, ...] = ()
    plainer: Callable[[Values], tuple[str, dict[str, float]] | None] | None = None
    is_plainer: Callable[[Values], bool] | None = None
    stand_in: Callable[[Values, FloatArray], bool] | None = None

    def remembers(self, given: Iterable[str]) -> bool:
        """Whether it has its memory with the parameters that are given."""
        return bool(self.memory) and (not self.at_once or self.unless in given)


def curves(signal: FloatArray) -> list[Tried]:
    """Return bends of a characteristic about the middle of a signal, of second and of third order."""
    size, middle = float(np.std(signal)) + 1e-300, float(np.mean(signal))
    return [
        Tried({"second_order": 0.05 / size, "origin": middle}, ("second_order",)),
        Tried({"third_order": 0.05 / size**2, "origin": middle}, ("third_order",)),
    ]
