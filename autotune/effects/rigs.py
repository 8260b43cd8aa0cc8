"""Kinds of rigs: what a model's signals and structure say it is, which tells what may be missing in it."""

from __future__ import annotations

import re
from typing import Literal, TypeAlias

from autotune.effects.base import Chain
from autotune.models import FILLED, HEATED, TEMPERATURE_UNITS, Model

#: ``arm``: an angle that gravity or a spring pulls back; ``shaft``: an angle that nothing does; ``carriage``: a
#: position; ``lifted``: a body that floats; ``speed``: a drive whose speed is measured; ``oscillator``: any other mode
#: that rings; ``level``, ``thermal``: what is stored; ``valve``: a loop with a valve; ``damper``: a force over a speed;
#: ``process``: what settles and says no more of itself.
RigKind: TypeAlias = Literal[
    "arm", "shaft", "carriage", "lifted", "speed", "oscillator", "level", "thermal", "valve", "damper", "process"
]
_ANGLES = ("rad", "deg", "\N{DEGREE SIGN}")


def rig_kind(model: Model, chain: Chain) -> RigKind:
    """Return what kind of rig a model describes, by its structure first, then by its units and names.

    Parameters
    ----------
    model : Model
        Names and units of blocks and measurement.
    chain : Chain
        Its linear chain.
    """
    unit = model.output.unit.strip().lower()
    said = " ".join((model.name, *(f"{b.name} {b.output}" for b in model.blocks))).lower()
    if chain.is_static:
        return "damper"
    if unit in _ANGLES and chain.has_travel:
        return "shaft" if chain.is_integrating else "arm"
    if chain.has_travel and chain.is_integrating:
        return "lifted" if re.search(r"\b(ball|levit|maglev|hover)", said) else "carriage"
    if chain.has_travel:
        return "oscillator"
    if chain.is_mechanical:
        return "speed"
    if unit in TEMPERATURE_UNITS or HEATED.search(said):
        return "thermal"
    if re.search(r"\bvalve\b|\bflow\b|\bpressure\b", said):
        return "valve"
    if FILLED.search(said):
        return "level"
    return "process"
