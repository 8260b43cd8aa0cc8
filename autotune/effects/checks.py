"""What an effect's record must have: everything that is missing or contradicts itself is refused at import."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from typing import get_args

from autotune.effects.base import EffectKind, Role, SignalSizes
from autotune.effects.rigs import RigKind
from autotune.effects.stages import STAGES, Line, StageName
from autotune.errors import InputError

PLACES = ("actuator", "plant", "sensor", "timing", "environment", "controller")
#: What a unit may refer to.
UNITS = {"u": "V", "f": "N", "v": "m/s", "y": "m"}
#: Signals of a usual size, on which starting values are tried.
_SIZES = SignalSizes(
    w=1.0, f=1.0, v=1.0, x=1.0, y=1.0, w_low=-1.0, w_high=1.0, y_low=-1.0, y_high=1.0, x_offset=0.0, f_peak=1.0,
    gain=1.0, lag_s=1.0, dt_s=0.01, duration_s=100.0, levels=0,
)  # fmt: skip
#: What the functions of a linear part take.
_LINEAR_TAKES = {"blocks": 2, "falling": 2, "u_offset": 1, "start": 3}


def require_complete(kinds: Sequence[EffectKind]) -> None:
    """Refuse records that are incomplete.

    Raises
    ------
    InputError
        The first that is wrong, with what is missing and how to add it.
    """
    names = [kind.name for kind in kinds]
    for kind in kinds:
        for what, remedy in (*_of(kind), *_relation_problems(kind, names)):
            raise InputError(what, where=f"effect {kind.name}", remedy=remedy)


def _of(kind: EffectKind) -> Iterator[tuple[str, str]]:
    """Yield what is wrong with a record and how to fix it."""
    if kind.place not in PLACES or "." not in kind.name:
        yield f"no place {kind.place!r}", f"name it PLACE.EFFECT, with a place of {', '.join(PLACES)}"
    for key in ("equation", "reference"):
        if not getattr(kind, key).strip():
            yield f"no {key}", f"give {key} a text"
    if not kind.parameters:
        yield "no parameters", "give it at least one Quantity"
    for q in kind.parameters:
        if q.role not in get_args(Role):
            yield f"parameter {q.name!r} has no role {q.role!r}", f"its role is one of {', '.join(get_args(Role))}"
    yield from _units(kind)
    if (kind.goes_on is not None) is not ([q.name for q in kind.parameters[-2:]] == ["low", "high"] and _marks(kind)):
        yield "goes_on and ends() go together", "end parameters with *ends(UNIT) and give goes_on, or give neither"
    observed = all(q.role == "observed" for q in kind.parameters)
    if observed and kind.is_simulated:
        yield "a simulated effect has observed parameters", "give its parameters the roles that a search needs"
    if kind.sought == "equations" and kind.in_equations is None:
        yield "nothing would be simulated", "give in_equations=InEquations(...)"
    if not observed and not kind.is_simulated and kind.sought != "equations":
        yield "nothing would be simulated", "add lines=(Line(stage=..., does=...),) or linear=LinearPart(...)"
    if kind.sought in ("hypothesis", "rig", "structure") and not _has_starts(kind):
        yield "no fit would ever start", "give starts=lambda sizes: [...] or search=..."
    for rig in kind.odds:
        if rig not in (*get_args(RigKind), "any"):
            yield f"odds of no kind of rig: {rig!r}", f"kinds are {', '.join(get_args(RigKind))}, any"
    if kind.is_simulated:
        yield from _simulation_problems(kind)
    yield from _starts(kind)


def _marks(kind: EffectKind) -> bool:
    """Whether the last two parameters are marks, not limits that a fit moves."""
    return all(q.role == "mark" for q in kind.parameters[-2:])


def _units(kind: EffectKind) -> Iterator[tuple[str, str]]:
    """Yield which units refer to nothing."""
    for q in kind.parameters:
        try:
            q.unit.format(**UNITS)
        except (KeyError, IndexError, ValueError):
            yield (
                f"unit {q.unit!r} of parameter {q.name!r} refers to nothing",
                f"signals are {', '.join(f'{{{name}}}' for name in UNITS)}",
            )


def _starts(kind: EffectKind) -> Iterator[tuple[str, str]]:
    """Yield what is wrong with starting values: a set is as long as the parameters, but for neutral ones at its end."""
    needed = tuple(q.name for q in kind.parameters if q.neutral is None)
    for values in kind.starts(_SIZES):
        given = tuple(q.name for q in kind.parameters[: len(values)])
        if len(given) != len(values) or not set(needed) <= set(given):
            names = ", ".join(q.name for q in kind.parameters)
            yield (
                f"starting values {values} are not one for each parameter",
                f"give values of {names}, in this order",
            )
            return


def _has_starts(kind: EffectKind) -> bool:
    return kind.search is not None or kind.starts.__name__ != "no_starts"


def _simulation_problems(kind: EffectKind) -> Iterator[tuple[str, str]]:
    used = set()
    for line in kind.lines:
        yield from _line(kind, line)
        used |= set(inspect.signature(line.does).parameters)
    if kind.memory is not None and kind.memory.name not in used:
        yield f"no line takes its memory {kind.memory.name!r}", "name an argument of a line so, or leave memory out"
    if kind.linear is None:
        for q in kind.parameters:
            if q.name not in used and q.role != "observed":
                yield f"parameter {q.name!r} acts nowhere", f"take {q.name} as an argument of one of its lines"
        return
    part = kind.linear
    if not (part.blocks or part.u_offset):
        yield "its linear part changes nothing", "give it blocks=... or u_offset=..."
    if part.states and part.start is None:
        yield f"{part.states} state(s) without start", "give its linear part start=..."
    for key, count in _LINEAR_TAKES.items():
        function = getattr(part, key)
        if function is not None and len(inspect.signature(function).parameters) != count:
            yield f"{key} of its linear part takes other than {count} arguments", "see LinearPart"


def _line(kind: EffectKind, line: Line) -> Iterator[tuple[str, str]]:
    """Yield which arguments of a line mean nothing."""
    if line.stage not in get_args(StageName):
        yield f"no stage {line.stage!r}", f"its stage is one of {', '.join(get_args(StageName))}"
        return
    stage, memory = STAGES[line.stage], () if kind.memory is None else (kind.memory.name,)
    own = {q.name for q in kind.parameters}
    taken = tuple(inspect.signature(line.does).parameters)
    known = (*stage.value, *stage.signals, *stage.held, *memory)
    for name in taken:
        if name in own and name in known:
            yield f"{name!r} is a parameter and a signal of stage {line.stage}", "give the parameter another name"
        if name not in own and name not in known:
            yield (
                f"its line takes {name!r}, which is neither a signal of stage {line.stage} nor a parameter",
                f"signals are {', '.join(known)}; parameters are {', '.join(sorted(own))}",
            )
    for name in stage.value:
        if name not in taken:
            yield f"its line does not take {name!r}", f"stage {line.stage} passes {', '.join(stage.value)} through"


def _relation_problems(kind: EffectKind, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    if names.count(kind.name) > 1:
        yield "stands twice in the catalogue", "give one of them another name"
    for key in ("same", "like", "excludes", "includes"):
        for other in getattr(kind, key):
            if other not in names:
                yield f"{key} names {other!r}, which does not exist", "use a name of the catalogue"
    for place in kind.places:
        if place not in PLACES:
            yield f"no place {place!r}", f"places are {', '.join(PLACES)}"
