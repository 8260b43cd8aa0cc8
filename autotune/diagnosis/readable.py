"""An effect's numbers as people read them: by their names, and as the command that does the same."""

from __future__ import annotations

import math
from collections.abc import Mapping

from autotune.effects import kind_of
from autotune.models import Effect, Parameter


def in_commands(
    name: str, parameters: Mapping[str, Parameter], command: float, unit: str
) -> dict[str, Parameter]:  # fmt: skip
    """Return the sizes of an effect that add to what drives the plant as the steady command that does the same.

    Parameters
    ----------
    name, parameters
        The effect, with its numbers as people read them.
    command : float
        Command that does what 1 at the effect's place does.
    unit : str
        Of the command.
    """
    found = {}
    for key, p in parameters.items():
        q = kind_of(name).quantity(key)
        if q is not None and q.role == "amplitude" and "{f}" in q.unit:
            factor = command if q.sign == "real" else abs(command)
            of = unit if q.unit == "{f}" else ""
            found[key] = Parameter(value=p.value * factor, sd=p.sd * abs(factor), unit=of)
    return found


def readable(effect: Effect) -> dict[str, Parameter]:
    """Return an effect's parameters as people name them: limits that do not act are left out."""
    kind = kind_of(effect.name)
    parameters = dict(effect.parameters) if kind.readable is None else kind.readable(effect.parameters)
    for q in kind.parameters:
        if q.role == "amplitude" and q.held is not None and q.held(effect.values):
            parameters.pop(q.name, None)  # its size is another number's, as gravity's is the spring's
        unfelt = q.role == "limit" and q.name in parameters and not math.isfinite(parameters[q.name].sd)
        if q.role == "mark" or unfelt:
            parameters.pop(q.name, None)
    return parameters
