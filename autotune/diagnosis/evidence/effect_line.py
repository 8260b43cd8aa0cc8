"""An effect's line of the catalogue as a function of one signal: which one that is, and what the line gives there."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.evidence.missing_law import LawLine
from autotune.diagnosis.evidence.residual import filled
from autotune.diagnosis.evidence.stretches import correlation_rows
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.simulation.assembly import values_of
from autotune.effects.base import EffectKind
from autotune.effects.stages import Line, StageName

Signal: TypeAlias = Literal["command", "speed", "position", "level", "plant input", "true reading", "time"]
#: Where stages add what passes through them to, and the chain's input for that: the reading is none.
ADDED: Mapping[StageName, tuple[str, int]] = {
    "converter": ("command", 0),
    "command": ("command", 0),
    "load": ("plant", 1),
    "force": ("plant", 1),
    "friction": ("plant", 1),
    "outflow": ("last", 2),
    "sensor": ("reading", -1),
    "reading": ("reading", -1),
}
_COLUMNS: Mapping[Signal, int] = {"true reading": 2, "position": 2, "level": 2, "speed": 1, "plant input": 3}


@dataclass(frozen=True, kw_only=True, eq=False)
class EffectLine(LawLine):
    """A line of a fitted effect.

    Attributes
    ----------
    result : Fit
        Whose model has the effect.
    data : Data
        What it was fitted to.
    number : int
        The effect's number in the model.
    kind : EffectKind
        What is known of it.
    line : Line
        The line that is drawn.
    """

    result: Fit
    data: Data
    number: int
    kind: EffectKind
    line: Line

    @property
    def name(self) -> str:
        """The effect's name."""
        return self.kind.name

    @property
    def asks(self) -> tuple[str, ...]:
        """The line's arguments."""
        return tuple(inspect.signature(self.line.does).parameters)

    @property
    def remembers(self) -> bool:
        """Whether what it does depends on the way that its signal came."""
        return self.kind.memory is not None

    @property
    def per_input(self) -> bool:
        """Whether it multiplies the plant's input."""
        return self.line.stage == "force" and "w" in self.asks

    @property
    def signal(self) -> Signal:
        """The signal that the law is drawn over."""
        asks, stage = self.asks, self.line.stage
        if "t" in asks:
            return "time"
        if "through" in asks:
            return "plant input"
        if stage in ("converter", "command"):
            return "command"
        if stage in ("sensor", "reading"):
            return "true reading"
        if stage == "friction" or "v" in asks:
            return "speed"
        return "position" if self.result.sim.chain.is_mechanical else "level"

    @property
    def is_whole(self) -> bool:
        """Whether it is a characteristic from its signal to the same quantity, else something that is added."""
        return self.signal in ("command", "true reading")

    @property
    def origin(self) -> float:
        """The signal's value at the operating point, from which on the line counts it."""
        sim = self.result.sim
        if self.signal == "command":
            return float(sim.u_offset)
        return float(sim.y_offset) if self.signal in ("position", "level", "true reading") else 0.0

    @property
    def unit(self) -> str:
        """Unit of the signal."""
        model = self.result.parametrisation.model
        match self.signal:
            case "time":
                return "s"
            case "command":
                return model.input.unit
            case "plant input":
                return model.plant_input_unit
            case "speed":
                return model.speed_unit
            case _:
                return model.output.unit

    @property
    def turns_round(self) -> bool:
        """Whether it turns round where its signal changes sign."""
        return self.line.stage == "friction"

    @property
    def words(self) -> tuple[str, str, str, str]:
        """The signal that it is drawn over with its unit, and what it gives with its unit."""
        model, to = self.result.parametrisation.model, ADDED[self.line.stage][0]
        if self.per_input:
            given = "change of the plant's gain", "share"
        elif to == "command":
            given = "command that acts", model.input.unit
        elif to == "plant":
            given = "net inflow" if self.signal == "level" else "force at the plant's input", model.plant_input_unit
        else:
            given = "flow at the lower level's input" if to == "last" else "reading", model.output.unit
        return self.signal, self.unit, *given

    def numbers(self) -> tuple[FloatArray, list[int], FloatArray]:
        """Return the fit's numbers, which of them are the effect's own, and the covariance of these."""
        free = enumerate(self.result.parametrisation.free)
        own = [i for i, f in free if f.kind == "effect" and f.index[0] == self.number]
        return self.result.theta, own, self.result.covariance[np.ix_(own, own)]

    def values(self) -> list[FloatArray]:
        """Return the signal, (N,) per recording; command, position, level and reading as absolute values."""
        if self.signal == "time":
            return [r.t - r.t[0] for r in self.data.recordings]
        if self.signal == "command":
            return [r.u for r in self.data.recordings]
        column = _COLUMNS[self.signal]
        return [filled(s)[:, column] + self.origin for s in self.result.signals]

    def counts(self) -> BoolArray:
        """Return the rows, all recordings one after the other, that are in a window and count."""
        inside = [np.isfinite(s[:, 0]) & ok for s, ok in zip(self.result.signals, self.data.good, strict=True)]
        return np.concatenate(inside)

    def law(self, x: FloatArray, theta: FloatArray, number: int = 0) -> FloatArray:
        """Return what the line gives as its signal passes values.

        Parameters
        ----------
        x : (K,) array
            The signal, in the order in which it passes them: what remembers starts at the first.
        theta : (p,) array
            Numbers of the fit.
        number : int
            The recording's, for loads that come in one of them.

        Returns
        -------
        (K,) array
            The whole characteristic, or what is added.
        """
        model, memory = self.result.parametrisation.model, self.kind.memory
        effect = self.result.parametrisation.with_values(theta).effects[self.number]
        values = values_of(effect, model)
        travel = next((line for line in self.kind.lines if line.stage == "travel"), None)
        from_origin, asks, result = np.asarray(x - self.origin), self.asks, np.empty(x.size)
        name = memory.name if memory is not None else ""
        held = 0.0 if memory is not None and memory.start == "travel" else float(from_origin[0])
        given = self._constants(number) | {name: held}
        before = float(from_origin[0])
        for k, value in enumerate(from_origin.tolist()):
            given |= self._own(value) | values  # a parameter may bear a signal's name, and is meant then
            if travel is not None:
                given["dx"], before = value - before, value
                given[name] = travel.does(**{key: given[key] for key in inspect.signature(travel.does).parameters})
            out = self.line.does(**{key: given[key] for key in asks})
            if isinstance(out, tuple):
                out, given[name] = out
            result[k] = out
        if self.line.stage == "friction":
            return -result * np.sign(from_origin)
        return result + self.origin if self.line.stage in ("command", "sensor") and self.is_whole else result

    def _constants(self, number: int) -> dict[str, Any]:
        sim = self.result.sim
        gain, gain_last = (float(g) for g in sim.chain.gains[:2])
        return {
            "offset": sim.u_offset, "y_offset": sim.y_offset, "kelvin": sim.kelvin, "number": float(number),
            "gain": gain, "gain_last": gain_last,
        }  # fmt: skip

    def _own(self, value: float) -> dict[str, Any]:
        """Return the line's arguments that go with the signal; the upper of two levels stays where it is."""
        absolute = value + self.origin
        return {
            "u": absolute, "y": absolute, "v": value, "x": value, "t": value, "through": value,
            "w": 1.0 if self.per_input else value, "z": value if self.signal == "true reading" else 0.0,
            "level": 0.0 if self.line.stage == "outflow" else value,
        }  # fmt: skip

    def traced_back(self, bins: Sequence[BoolArray]) -> tuple[FloatArray, FloatArray]:
        """Return how much, added where it acts at the rows of each bin, explains the residual best, and its 1-sigma."""
        factor = np.concatenate([filled(s)[:, 3] for s in self.result.signals]) if self.per_input else 1.0
        splits = np.cumsum([len(r) for r in self.data.recordings])[:-1]
        X = self._shows(np.split(np.column_stack([np.where(rows, factor, 0.0) for rows in bins]), splits))
        norms = np.linalg.norm(X, axis=0)
        scale = np.where(norms > 0.0, norms, 1.0)
        X, e = X / scale, self.result.without_states(self.result.e)
        inverse = np.linalg.pinv(X.T @ X, rcond=1e-9, hermitian=True)
        beta = inverse @ (X.T @ e)
        left = e - X @ beta
        excess = max(1.0, float(left @ left) / max(self.data.rows - beta.size, 1))
        variance = np.maximum(np.diag(inverse), 0.0) * excess * correlation_rows(self.result, self.data)
        return beta / scale, np.where(norms > 0.0, np.sqrt(variance) / scale, math.inf)

    def _shows(self, columns: list[FloatArray]) -> FloatArray:
        """Return how signals that are added where the effect acts show in the whitened residual, start states freed.

        They are (N, q) per recording, and what they show is (N, q), all recordings one after the other.
        """
        sim, data = self.result.sim, self.data
        way = ADDED[self.line.stage][1]
        plain, shown = sim.driven_at(max(way, 0)), []
        for q in range(columns[0].shape[1]):
            rows = []
            for r, s, ok, windows in zip(data.recordings, columns, data.good, data.windows_here, strict=True):
                driven = replace(r, u=np.ascontiguousarray(s[:, q]), extra={})
                out = s[:, q] if way < 0 else plain.run(driven, np.zeros(sim.order), windows, signals=1)[0][:, 0]
                rows.append(np.where(ok, out, 0.0))
            shown.append(self.result.without_states(np.concatenate(data.whitened(rows))))
        return np.column_stack(shown)


def line_of(result: Fit, data: Data, number: int, kind: EffectKind) -> EffectLine | None:
    """Return the first line of an effect that is a law over one signal that the fit has."""
    for line in kind.lines:
        asks = set(inspect.signature(line.does).parameters)
        two, of_law = result.sim.chain.levels == 2, result.sim.chain.is_static
        known = line.stage in ADDED and "dt" not in asks and (two or line.stage != "outflow")
        known = known and not (two and line.stage == "force" and "level" in asks)
        if known and ("through" in asks if of_law and len(kind.lines) > 1 else "through" not in asks):
            return EffectLine(result=result, data=data, number=number, kind=kind, line=line)
    return None
