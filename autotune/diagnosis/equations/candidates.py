"""Which effects can sit where in a model, and with which values they are tried: as their records say."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.equations.followed import positions_of, speeds_of
from autotune.effects import ALL, KINDS
from autotune.effects.in_equations import Around, InEquations, Tried
from autotune.equations.effects import where_of
from autotune.equations.model import EquationModel
from autotune.models import Effect, Parameter


@dataclass(frozen=True, kw_only=True)
class Trial:
    """An effect with values to try.

    Attributes
    ----------
    effect : Effect
        With those values.
    scaled : tuple of str
        Parameters that are its amplitude: first order tells how large, and with which sign.
    """

    effect: Effect
    scaled: tuple[str, ...] = ()


def key_of(effect: Effect) -> tuple[str, str, str]:
    """Return what tells effects of a hypothesis apart: the name, the place that it acts on, and the column it is of."""
    return effect.name, where_of(effect), effect.column


def form_of(effect: Effect) -> InEquations:
    """Return how an effect that is tried acts in equations."""
    form = KINDS[effect.name].in_equations
    assert form is not None
    return form


def is_usual(effect: Effect) -> bool:
    """Whether nearly every machine has it: tried beside a large effect whatever others predict."""
    return form_of(effect).usual


def plainer(effect: Effect) -> Effect | None:
    """Return the effect of fewer numbers that another one comes down to in a limit; nothing where there is none."""
    form = form_of(effect)
    less = None if form.plainer is None else form.plainer(effect.values)
    if less is None:
        return None
    name, values = less
    known = effect.parameters
    parameters = {k: replace(known.get(k, Parameter(value=v)), value=v) for k, v in values.items()}
    return replace(effect, name=name, parameters=MappingProxyType(parameters))


def is_plainer(effect: Effect) -> bool:
    """Whether an effect came to where it is one of fewer numbers."""
    form = form_of(effect)
    return form.is_plainer is not None and form.is_plainer(effect.values)


def is_signed(effect: Effect, key: str) -> bool:
    """Whether a parameter of an effect may have either sign."""
    quantity = KINDS[effect.name].quantity(key)
    return key in form_of(effect).either_sign or (quantity is not None and quantity.sign == "real")


@dataclass(frozen=True, kw_only=True, eq=False)
class Signals:
    """What the recordings show under the retuned model.

    Attributes
    ----------
    u : (rows,) array
        The command.
    y : (rows,) array
        The simulated reading.
    values : mapping of state or port to (rows,) arrays
        States, and differences across ports.
    sizes : mapping of state or port to float
        How large a derivative (or a force at a port) typically is.
    columns : mapping of str to (rows,) arrays
        Further columns of the recordings, which the model does not have.
    lines : tuple of float
        Frequencies that stand out of the residual [Hz].
    dt_s, duration_s, slow_s : float
        Sample time, length of a recording, and the slowest lag that is looked for [s].
    """

    u: FloatArray
    y: FloatArray
    values: dict[str, FloatArray]
    sizes: dict[str, float]
    columns: dict[str, FloatArray]
    lines: tuple[float, ...]
    dt_s: float
    duration_s: float
    slow_s: float


def trials(
    model: EquationModel, signals: Signals, without: Collection[str] = (), black_box: bool = False
) -> list[Trial]:
    """Return every effect with the values it is tried with.

    Parameters
    ----------
    model : EquationModel
        Says what states, ports and inputs are.
    signals : Signals
        Sizes to try.
    without : collection of str
        Effects that are left out.
    black_box : bool
        Whether only inputs and output can be reached.
    """
    found: list[Trial] = []
    for kind in ALL:
        form = kind.in_equations
        if form is None or form.trials is None or kind.name in without:
            continue
        for key, name in _places(model, form, signals, black_box):
            tried = form.trials(_around(model, signals, key, name))
            found += [Trial(effect=_effect(kind.name, key, name, one), scaled=one.scaled) for one in tried]
    return found


def _effect(name: str, key: str, place: str, tried: Tried) -> Effect:
    parameters = MappingProxyType({k: Parameter(value=float(v)) for k, v in tried.values.items()})
    where = {key: place} if key else {}
    return Effect(name=name, parameters=parameters, column=tried.column, **where)


def _places(model: EquationModel, form: InEquations, s: Signals, black_box: bool) -> Iterator[tuple[str, str]]:
    """Yield key and name of every place where an effect may act, inside first."""
    anywhere, moves = form.acts == "anywhere", float(np.ptp(s.u)) > 0.0
    if form.acts == "force" or anywhere:
        if black_box:
            yield from (("input", one.column) for one in model.inputs if one.kind and form.free_timing)
        elif model.ports:  # without ports effects act on a state's derivative
            yield from (("port", one.name) for one in model.ports if anywhere or one.kind in form.on)
        else:
            moved = {one.of for one in model.states}  # a position moves by its speed alone
            yield from (("state", one.name) for one in model.states
                        if (anywhere and one.name not in moved) or one.kind in form.on)  # fmt: skip
    if form.acts in ("input", "held", "delay", "anywhere") and moves:  # a free decay says nothing of its actuator
        yield "input", model.columns[0]
    if form.acts in ("reading", "anywhere"):
        yield "", ""


def _around(model: EquationModel, s: Signals, key: str, name: str) -> Around:
    """Return what the recordings show around a place."""
    state = next((one for one in model.states if one.name == name), None)
    u, size = s.u - model.inputs[0].offset, s.sizes.get(name, 1.0)
    v = s.values.get(speeds_of(model).get(name, name), np.zeros(1))
    if not key:
        v, size = s.y, float(np.nanstd(s.y)) + 1e-300
    elif name == model.columns[0]:
        v, size = u, float(np.std(u)) + 1e-300
    held = next((one.name for one in model.states if one.kind in ("position", "level", "temperature")), "")
    of = held if key == "input" else positions_of(model)[name] if key == "port" or (state and state.of) else ""
    rate = float(np.std(np.diff(v) / s.dt_s)) if key == "port" else 0.0
    return Around(
        size=size, v=v, x=s.values.get(of, v), has_position=of in s.values, is_angle=_is_angle(model, key, name),
        unit=state.unit if state else "", kind=state.kind if state else "",
        per_rate=size / rate if rate > 0.0 else 1.0, u=u, y=s.y,
        offset=model.inputs[0].offset, dt_s=s.dt_s, duration_s=s.duration_s, slow_s=s.slow_s, lines=s.lines,
        columns=s.columns,
    )  # fmt: skip


def _is_angle(model: EquationModel, key: str, name: str) -> bool:
    """Whether the position at a place may be an angle in rad, as far as kinds and units say."""
    if key != "state":
        return any(one.name == name and one.kind == "torque" for one in model.ports)
    states = {one.name: one for one in model.states}
    return states[states[name].of or name].unit.strip() in ("", "rad")
