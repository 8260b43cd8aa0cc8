"""Which effects can sit where in a model, and with which values they are tried."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.model import EquationModel
from autotune.models import Effect, Parameter

#: Effects by what a state is, or by what acts at a port.
ON_SPEED = ("plant.coulomb_friction", "plant.quadratic_drag", "plant.viscous_friction", "plant.stribeck_friction")
ON_POSITION = ("plant.cubic_stiffness", "plant.sine_torque", "plant.hysteresis", "plant.hard_stop")
ON_LEVEL = ("plant.sqrt_outflow", "plant.leak", "plant.nonlinear_loss")
ON_TEMPERATURE = ("plant.radiation_loss", "plant.leak", "plant.nonlinear_loss")
LOADS = ("environment.step_load", "environment.periodic_load", "environment.drifting_load")
ON_COMMAND = (
    "actuator.saturation", "actuator.dead_zone", "actuator.nonlinear_gain", "actuator.offset", "actuator.gain_drift",
    "actuator.lag", "actuator.rate_limit", "actuator.backlash", "actuator.stiction", "timing.dead_time",
)  # fmt: skip
ON_READING = ("sensor.lag", "sensor.nonlinear_gain", "sensor.drift")
#: What nearly every machine has, and models leave out: tried beside a large effect whatever others predict.
USUAL = frozenset({"plant.coulomb_friction"})
MEASURED = "environment.measured_input"
#: Lags between a recorded column and what it acts on, as shares of the way from a sample to the slowest, in logarithms.
LAGS = (0.3, 0.65, 1.0)
#: Shares of the time that a position without a stop is on this side of it, where stops are tried.
STOPS = (0.8, 0.9, 0.97, 0.995)
BY_KIND = {
    "speed": ON_SPEED, "level": ON_LEVEL, "temperature": ON_TEMPERATURE, "pressure": ON_LEVEL, "current": (),
    "force": (*ON_SPEED, *ON_POSITION), "torque": (*ON_SPEED, *ON_POSITION), "flow": ON_LEVEL, "heat": ON_TEMPERATURE,
}  # fmt: skip


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
    return effect.name, place_of(effect), effect.column


def place_of(effect: Effect) -> str:
    """Return the state, port or input that an effect acts on; nothing for the reading."""
    return effect.state or effect.port or effect.input


def plainer(effect: Effect) -> Effect | None:
    """Return the effect of fewer numbers that another one comes down to in a limit; nothing where there is none."""
    if effect.name == "plant.sine_torque" and not is_gravity(effect):
        return gravity(effect, effect.parameters["amplitude"].value)
    if effect.name == MEASURED and "time_constant" in effect.parameters:
        without_lag = {key: q for key, q in effect.parameters.items() if key != "time_constant"}
        return replace(effect, parameters=MappingProxyType(without_lag))
    level = {"plant.stribeck_friction": "level", "plant.hysteresis": "amplitude"}.get(effect.name)
    if level is None:
        return None
    size = effect.parameters[level]
    parameters = MappingProxyType({"level": replace(size, value=abs(size.value))})
    return replace(effect, name="plant.coulomb_friction", parameters=parameters)


def gravity(effect: Effect, amplitude: float) -> Effect:
    """Return a sine torque as gravity on an angle: over one turn, from angle zero on; its amplitude alone is sought."""
    values = {"amplitude": Parameter(value=amplitude), "period": Parameter(value=2.0 * np.pi, unit="rad")}
    return replace(effect, parameters=MappingProxyType(values))


def is_gravity(effect: Effect) -> bool:
    """Whether an effect is gravity on an angle."""
    return effect.name == "plant.sine_torque" and "phase" not in effect.parameters


def is_plainer(effect: Effect) -> bool:
    """Whether an effect came to where it is one of fewer numbers: what breaks away at no more force than slides on."""
    if effect.name != "plant.stribeck_friction":
        return False
    return effect.parameters["breakaway"].value <= effect.parameters["level"].value


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
    dt_s, duration_s, slow_s : float
        Sample time, length of a recording, and the slowest lag that is looked for [s].
    """

    u: FloatArray
    y: FloatArray
    values: dict[str, FloatArray]
    sizes: dict[str, float]
    columns: dict[str, FloatArray]
    dt_s: float
    duration_s: float
    slow_s: float


def trials(model: EquationModel, signals: Signals, without: Sequence[str] = (), black_box: bool = False) -> list[Trial]:
    """Return every effect with the values it is tried with.

    Parameters
    ----------
    model : EquationModel
        Says what states, ports and inputs are.
    signals : Signals
        Sizes to try.
    without : sequence of str
        Effects that are left out.
    black_box : bool
        Whether only inputs and output can be reached.
    """
    moves = float(np.ptp(signals.u)) > 0.0  # a free decay says nothing of its actuator
    found = [*(_on_command(model, signals) if moves else ()), *_on_reading(signals)]
    if not black_box:
        places: list[tuple[str, str, str]] = [("port", port.name, port.kind) for port in model.ports]
        if not places:  # without ports effects act on a state's derivative
            places = [("state", state.name, state.kind) for state in model.states]
        for key, name, kind in places:
            for effect in BY_KIND.get(kind, ()):
                found += _on_place(model, signals, key, name, effect)
            if kind in ("speed", "level", "temperature", "force", "torque", "flow", "heat"):
                found += _loads(signals, key, name)
            if kind == "speed":
                found += [one for effect in ON_POSITION for one in _on_place(model, signals, key, name, effect)]
    else:
        for one in model.inputs:
            if one.kind:
                found += _loads(signals, "input", one.column)
    for key, name, force in _acted_on(model, signals, black_box):
        found += _measured(signals, key, name, force)
    return [one for one in found if one.effect.name not in without]


def _effect(name: str, key: str = "", place: str = "", **values: float) -> Effect:
    parameters = MappingProxyType({k: Parameter(value=float(v)) for k, v in values.items()})
    where = {key: place} if key else {}
    return Effect(name=name, parameters=parameters, **where)


def _on_place(model: EquationModel, s: Signals, key: str, name: str, effect: str) -> Iterator[Trial]:
    """Yield trials of an effect that acts as a force, flow or heat."""
    force = 0.05 * s.sizes.get(name, 1.0)
    v = s.values.get(name, np.zeros(1))
    size = max(float(np.quantile(np.abs(v), 0.9)), 1e-12)
    state = next((one for one in model.states if one.name == name), None)
    position = s.values.get(f"{name}:position" if key == "port" else (state.of if state else ""), None)
    match effect:
        case "plant.coulomb_friction":
            yield Trial(effect=_effect(effect, key, name, level=force), scaled=("level",))
        case "plant.stribeck_friction":
            for share in (0.03, 0.15):
                values = {"level": force, "breakaway": 2.0 * force, "stribeck_speed": share * size}
                yield Trial(effect=_effect(effect, key, name, **values), scaled=("level", "breakaway"))
        case "plant.viscous_friction":
            yield Trial(effect=_effect(effect, key, name, coefficient=force / size), scaled=("coefficient",))
        case "plant.quadratic_drag" | "plant.nonlinear_loss":
            yield Trial(effect=_effect(effect, key, name, coefficient=force / size**2), scaled=("coefficient",))
        case "plant.leak":
            yield Trial(effect=_effect(effect, key, name, rate=force / size), scaled=("rate",))
        case "plant.sqrt_outflow" if float(np.quantile(v, 0.05)) >= -0.05 * size:
            yield Trial(effect=_effect(effect, key, name, coefficient=force / np.sqrt(size)), scaled=("coefficient",))
        case "plant.radiation_loss":
            yield from _radiation(model, s, key, name, force)
        case _ if position is not None:
            yield from _on_position(key, name, effect, force, position, s, _is_angle(model, key, name))


def _radiation(model: EquationModel, s: Signals, key: str, name: str, force: float) -> Iterator[Trial]:
    units = {one.name: one.unit for one in model.states}
    zero = 0.0 if units.get(name, "").strip().lower() in ("k", "kelvin") else 273.15
    v = s.values.get(name, np.zeros(1))
    top = float(np.max(v)) + zero
    if top > 100.0:
        ground = float(np.min(v)) + zero
        values = {"coefficient": force / max(top**4 - ground**4, 1e-300), "zero": zero, "surroundings": ground}
        # where the surroundings are is not sought: a loss there is the same as an offset
        yield Trial(effect=_effect("plant.radiation_loss", key, name, **values), scaled=("coefficient",))


def _is_angle(model: EquationModel, key: str, name: str) -> bool:
    """Whether the position at a place may be an angle in rad, as far as kinds and units say."""
    if key == "port":
        return any(one.name == name and one.kind == "torque" for one in model.ports)
    states = {one.name: one for one in model.states}
    return states[states[name].of or name].unit.strip() in ("", "rad")


def _on_position(
    key: str, name: str, effect: str, force: float, x: FloatArray, s: Signals, is_angle: bool
) -> Iterator[Trial]:
    span = float(np.max(x) - np.min(x)) + 1e-300
    match effect:
        case "plant.cubic_stiffness":
            size = float(np.quantile(np.abs(x), 0.95)) + 1e-300
            yield Trial(effect=_effect(effect, key, name, coefficient=force / size**3), scaled=("coefficient",))
        case "plant.sine_torque":
            if is_angle:
                yield Trial(effect=gravity(_effect(effect, key, name), force), scaled=("amplitude",))
            for period in (0.2 * span, 0.35 * span, 0.6 * span, 2.0 * np.pi):
                for phase in (0.0, 0.5 * np.pi):
                    values = {"amplitude": force, "period": period, "phase": phase or 1e-3}
                    yield Trial(effect=_effect(effect, key, name, **values), scaled=("amplitude",))
        case "plant.hysteresis":
            for share in (0.05, 0.25):
                values = {"amplitude": force, "width": share * span}
                yield Trial(effect=_effect(effect, key, name, **values), scaled=("amplitude",))
        case "plant.hard_stop":
            # at a port a force, which an inertia turns into an acceleration
            rate = float(np.std(np.diff(s.values[name]) / s.dt_s)) if key == "port" else 0.0
            stiffness = (0.5 / s.dt_s) ** 2 * (s.sizes[name] / rate if rate > 0.0 else 1.0)
            for side, share in ((side, share) for share in STOPS for side in ("high", "low")):
                level = np.quantile(x, share if side == "high" else 1.0 - share)
                values = {side: float(level), "stiffness": stiffness, "damping": 2.0 * s.dt_s * stiffness}
                yield Trial(effect=_effect(effect, key, name, **values))


def _acted_on(model: EquationModel, s: Signals, black_box: bool) -> Iterator[tuple[str, str, float]]:
    """Yield key, name and size of every place where a measured signal may act, inside first."""
    if not black_box:
        speeds_of = {one.of for one in model.states}
        free = [one.name for one in model.states if one.name not in speeds_of]  # a position moves by its speed alone
        for key, name in [("port", one.name) for one in model.ports] or [("state", name) for name in free]:
            yield key, name, s.sizes.get(name, 1.0)
    yield "input", model.columns[0], float(np.std(s.u)) or 1.0
    yield "", "", float(np.nanstd(s.y)) or 1.0


def _measured(s: Signals, key: str, name: str, size: float) -> Iterator[Trial]:
    """Yield recorded columns that act at a place: as they are and from their mean on, at once and with a lag."""
    slowest = np.log(s.slow_s / s.dt_s)
    for column, d in s.columns.items():
        for reference in dict.fromkeys((0.0, float(np.mean(d)))):
            values = {"gain": 0.05 * size / float(np.std(d)), "reference": reference}
            for lag in ({}, *({"time_constant": s.dt_s * float(np.exp(share * slowest))} for share in LAGS)):
                effect = replace(_effect(MEASURED, key, name, **values, **lag), column=column)
                yield Trial(effect=effect, scaled=("gain",))


def _loads(s: Signals, key: str, name: str) -> Iterator[Trial]:
    force = 0.05 * s.sizes.get(name, 1.0)
    for share in np.linspace(0.04, 0.96, 24):
        values = {"amplitude": force, "time": float(share) * s.duration_s}
        yield Trial(effect=_effect("environment.step_load", key, name, **values), scaled=("amplitude",))
    yield Trial(effect=_effect("environment.drifting_load", key, name, rate=force / s.duration_s), scaled=("rate",))


def _on_command(model: EquationModel, s: Signals) -> Iterator[Trial]:
    column = model.columns[0]
    at = ("input", column)
    offset = model.inputs[0].offset
    u = s.u - offset
    size = float(np.std(u)) + 1e-300
    top, bottom = (float(np.quantile(u, q)) for q in (0.999, 0.001))
    for share in (0.05, 0.2, 0.4):
        yield Trial(effect=_effect("actuator.saturation", *at, high=top - share * (top - bottom)))
        yield Trial(effect=_effect("actuator.saturation", *at, low=bottom + share * (top - bottom)))
    for share in (0.1, 0.4):
        yield Trial(effect=_effect("actuator.dead_zone", *at, half_width=share * size))
    middle = float(np.mean(u))
    yield Trial(effect=_effect("actuator.nonlinear_gain", *at, second_order=0.05 / size, origin=middle),
                scaled=("second_order",))  # fmt: skip
    yield Trial(effect=_effect("actuator.nonlinear_gain", *at, third_order=0.05 / size**2, origin=middle),
                scaled=("third_order",))  # fmt: skip
    yield Trial(effect=_effect("actuator.offset", *at, offset=0.05 * size), scaled=("offset",))
    yield Trial(effect=_effect("actuator.gain_drift", *at, rate=0.05 / s.duration_s), scaled=("rate",))
    for factor in (2.0, 8.0, 30.0):
        yield Trial(effect=_effect("actuator.lag", *at, time_constant=min(factor * s.dt_s, s.slow_s)))
        yield Trial(effect=_effect("timing.dead_time", *at, delay=min(factor * s.dt_s, s.slow_s)))
    moves = np.abs(np.diff(u))
    moves = moves[moves > 1e-6 * size]  # between its steps a held command says nothing of how fast it may move
    step = float(np.quantile(moves, 0.9)) if moves.size else size
    for rows in (3.0, 10.0, 30.0):
        yield Trial(effect=_effect("actuator.rate_limit", *at, rate=step / (rows * s.dt_s)))
    for share in (0.2, 0.6):
        yield Trial(effect=_effect("actuator.backlash", *at, width=share * size))
        yield Trial(effect=_effect("actuator.stiction", *at, band=share * size))


def _on_reading(s: Signals) -> Iterator[Trial]:
    size, middle = float(np.nanstd(s.y)) + 1e-300, float(np.nanmean(s.y))
    for factor in (3.0, 15.0):
        yield Trial(effect=_effect("sensor.lag", time_constant=min(factor * s.dt_s, s.slow_s)))
    yield Trial(effect=_effect("sensor.nonlinear_gain", second_order=0.05 / size, origin=middle),
                scaled=("second_order",))  # fmt: skip
    yield Trial(effect=_effect("sensor.nonlinear_gain", third_order=0.05 / size**2, origin=middle),
                scaled=("third_order",))  # fmt: skip
    yield Trial(effect=_effect("sensor.drift", rate=0.05 * size / s.duration_s), scaled=("rate",))
