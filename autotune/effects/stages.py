"""How an effect acts in a simulation: lines at its stages, memory between steps, and changes of the linear chain."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from autotune.arrays import FloatArray
from autotune.models import Block

Values: TypeAlias = Mapping[str, float]
Blocks: TypeAlias = tuple[Block, ...]
StageName: TypeAlias = Literal[
    "clock", "converter", "command", "load", "force", "travel", "friction", "outflow", "stop", "sensor", "reading"
]


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A place of the compiled simulation where lines act.

    Attributes
    ----------
    value : tuple of str
        What passes through and comes back changed; empty where contributions are added up.
    signals : tuple of str
        What a line may ask for besides.
    held : tuple of str
        What it may ask for that stays as it is through a run.
    is_force : bool
        Whether it acts at the plant within a sub-step.
    """

    value: tuple[str, ...] = ()
    signals: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    is_force: bool = False


#: The stages in the order in which a sample passes them. ``t`` counts from the recording's first row [s].
STAGES: Mapping[StageName, Stage] = {
    # when a command acts: time since the first row, in and out
    "clock": Stage(value=("elapsed",)),
    # the absolute command
    "converter": Stage(value=("u",), signals=("t",)),
    # the command from the operating point on; ``offset`` is the command there, ``number`` the recording's
    "command": Stage(value=("w",), signals=("offset", "dt", "t", "number")),
    # forces at the plant's input that no state changes
    "load": Stage(signals=("t", "number"), is_force=True),
    # forces that go with plant input w, speed v, position or level x, first level, gain from force to speed or level;
    # ``kelvin`` is the absolute temperature at the operating point, were y one
    "force": Stage(signals=("w", "v", "x", "level", "t", "number"), held=("y_offset", "gain", "kelvin"), is_force=True),
    # what is remembered of a travel dx of the position, after every sub-step's first trial
    "travel": Stage(signals=("dx", "dt"), is_force=True),
    # level of a dry friction, which at most stops the motion
    "friction": Stage(signals=("v",), is_force=True),
    # what is added at the input of the plant's last block, whose gain is ``gain_last``
    "outflow": Stage(signals=("x", "level"), held=("gain_last",), is_force=True),
    # position and speed after a sub-step; ``y_offset`` is the reading at position 0
    "stop": Stage(value=("x", "v"), held=("y_offset",)),
    # the last block's output; ``through`` is the input of a plant that is a law without dynamics, 0 of any other
    "sensor": Stage(value=("z",), signals=("t", "through")),
    # the absolute reading
    "reading": Stage(value=("y",), signals=("t",)),
}


@dataclass(frozen=True, kw_only=True)
class Line:
    """A function of the compiled simulation: scalars in, the stage's value or contribution out.

    Its source is copied into the generated simulation: it may use ``math`` and functions of its own file. Where the
    effect has a memory the function may take it by its name; in a stage with a value it then returns value and memory,
    in ``travel`` the memory alone.
    """

    stage: StageName
    does: Callable[..., Any]


@dataclass(frozen=True, kw_only=True)
class Memory:
    """What an effect keeps from one sub-step to the next.

    Attributes
    ----------
    name : str
        The lines' argument.
    start : {"command", "replay", "travel"}
        What it is where a window begins that follows no other: the command in force there; what every command before
        has made of it, as of a play; what the simulation's travel has made of it since the first window's beginning,
        where it is 0.
    """

    name: str
    start: Literal["command", "replay", "travel"] = "command"


@dataclass(frozen=True, kw_only=True)
class LinearPart:
    """What an effect makes of the chain itself.

    Attributes
    ----------
    blocks : callable
        The chain's blocks with the effect in them.
    falling : callable, optional
        The blocks that act while the command falls; what rises follows ``blocks``.
    u_offset : callable, optional
        What is added to the command's operating point.
    states : int
        States that it adds, ``at`` the chain's front or back.
    unless_lagged : bool
        Whether it adds none where an actuator's lag is there already.
    start : callable, optional
        Start states of those, (W, states), for windows with commands before them and linear outputs, (W,) each.
    """

    blocks: Callable[[Blocks, Values], Blocks] | None = None
    falling: Callable[[Blocks, Values], Blocks] | None = None
    u_offset: Callable[[Values], float] | None = None
    states: int = 0
    at: Literal["front", "back"] = "back"
    unless_lagged: bool = False
    start: Callable[[FloatArray, FloatArray, Values], FloatArray] | None = None
