"""What can be put into a recording exactly, and why not where it cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim.recorded import commands, readings
from sim.recorded.readings import Maker
from sim.recorded.rigs import Record, RefusedError, Rig

#: Error of a reading guessed from its neighbours, over the residual, above which y between rows is not known.
BETWEEN = 2.0

_LAG = ("actuator.lag", "sensor.lag")
_LOAD_PLACES = ("environment", "actuator", "plant")


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One entry: its maker, what counts as naming it, and what it needs to be exact.

    ``on`` is "reading" or "command"; ``memory`` says that it acts between rows of the command too, ``between`` that it
    needs y between rows.
    """

    name: str
    on: str
    make: Maker
    accept: tuple[str, ...] = ()
    places: tuple[str, ...] = ()
    forecastable: bool = True
    memory: bool = False
    between: bool = False

    def accepted(self, rig: Rig) -> list[str]:
        """Names that count as right: command and reading alone cannot tell a drifting sensor from a drifting load."""
        names = {self.name, *self.accept}
        if rig.chain.integrates and self.name in ("sensor.drift", "environment.drifting_load"):
            names = {self.name}
        return sorted(names)


EFFECTS = (
    Effect(name="sensor.saturation", on="reading", make=readings.saturation),
    Effect(name="sensor.quantisation", on="reading", make=readings.quantisation),
    Effect(name="sensor.nonlinear_gain", on="reading", make=readings.nonlinear_gain),
    Effect(name="sensor.absolute_value", on="reading", make=readings.absolute_value),
    Effect(
        name="sensor.drift", on="reading", make=readings.drift, accept=("environment.drifting_load",),
        places=_LOAD_PLACES,
    ),
    Effect(
        name="sensor.lag", on="reading", make=readings.lag, accept=_LAG, places=("actuator", "plant"), between=True
    ),
    Effect(name="sensor.dropout", on="reading", make=readings.dropout, forecastable=False),
    Effect(name="sensor.outliers", on="reading", make=readings.outliers, forecastable=False),
    Effect(name="timing.clock_error", on="reading", make=readings.clock_error, between=True),
    Effect(name="timing.jitter", on="reading", make=readings.jitter, forecastable=False, between=True),
    Effect(
        name="timing.dead_time", on="reading", make=readings.dead_time, places=("actuator", "sensor", "plant")
    ),
    Effect(name="actuator.dead_zone", on="command", make=commands.dead_zone),
    Effect(name="actuator.nonlinear_gain", on="command", make=commands.nonlinear_gain),
    Effect(name="actuator.backlash", on="command", make=commands.backlash, memory=True),
    Effect(
        name="actuator.lag", on="command", make=commands.lag, accept=_LAG, places=("sensor", "plant"), memory=True
    ),
    Effect(name="actuator.gain_drift", on="command", make=commands.gain_drift, places=("plant",)),
    Effect(
        name="environment.step_load", on="command", make=commands.step_load, places=_LOAD_PLACES, forecastable=False
    ),
    Effect(name="environment.periodic_load", on="command", make=commands.periodic_load, places=_LOAD_PLACES),
    Effect(
        name="environment.drifting_load", on="command", make=commands.drifting_load, accept=("sensor.drift",),
        places=(*_LOAD_PLACES, "sensor"),
    ),
)  # fmt: skip
BY_NAME = {effect.name: effect for effect in EFFECTS}

#: Effects that no recording takes, and why.
NEVER = {
    "actuator.saturation": "the recorded command goes beyond every limit within its range, and what was asked for "
    "beyond its ends is not known",
    "actuator.rate_limit": "the recorded command moves faster than every limit that would act on it",
    "actuator.quantisation": "the recorded command does not lie on a converter's levels",
    "actuator.stiction": "between its jumps the command before a sticking valve is not known",
    "plant": "an effect within the plant changes everything after it; y is not known without a model",
    "controller.law": "the law of a recorded loop cannot be changed afterwards",
}


def require_exact(effect: Effect, rig: Rig, noise: float) -> None:
    """Refuse an effect that cannot be put into a rig's recordings exactly.

    Parameters
    ----------
    effect, rig
        What is put in, and where.
    noise
        Rms of the recording's own residual.

    Raises
    ------
    RefusedError
        With the reason.
    """
    if effect.on == "command" and not rig.moves:
        raise RefusedError("u is constant: nothing shows what a command does")
    if effect.memory and not rig.held:
        raise RefusedError("u is linear between rows, where an effect with a memory acts too")
    if effect.between and roughness(rig) > BETWEEN * noise:
        raise RefusedError("y moves too far from row to row for its value between them to be known")


def roughness(rig: Rig) -> float:
    """Rms error of each second reading guessed from its neighbours."""
    guessed = [r.y[1:-1] - 0.5 * (r.y[2:] + r.y[:-2]) for r in rig.given]
    return float(np.sqrt(np.mean(np.concatenate(guessed) ** 2)))


def require_no_converter(before: Sequence[Record], after: Sequence[Record]) -> None:
    """Refuse a changed command that rounding to the recorded one's levels turns into it, as a converter does.

    A command of few levels says no more: every effect that moves it by less than half their distance would be one.

    Parameters
    ----------
    before, after : sequence of Record
        The recordings as they are, and changed.

    Raises
    ------
    RefusedError
        With that reason.
    """
    levels = np.unique(np.concatenate([r.u for r in before]))
    middles = 0.5 * (levels[1:] + levels[:-1])
    rounded = all(
        np.array_equal(levels[np.searchsorted(middles, b.u)], a.u) for a, b in zip(before, after, strict=True)
    )
    same = all(np.array_equal(a.u, b.u) for a, b in zip(before, after, strict=True))
    if rounded and not same:
        raise RefusedError("a converter to the levels of the recorded command would explain the same")
