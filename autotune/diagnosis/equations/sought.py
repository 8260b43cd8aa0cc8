"""On what scale the numbers of effects are sought, which of them from outside the fits, and which not at all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from autotune.diagnosis.equations.candidates import Trial, place_of
from autotune.equations.model import ModelParameter
from autotune.equations.simulate import Compiled
from autotune.models import Effect

#: Parameters of effects that may have either sign, and those that are not sought.
SIGNED = frozenset({"high", "low", "second_order", "third_order", "offset", "phase", "time", "in_phase", "quadrature",
                    "amplitude", "fold", "gain"})  # fmt: skip
SIGNED_RATES = frozenset({"actuator.gain_drift", "sensor.drift", "environment.drifting_load", "plant.leak",
                          "plant.cubic_stiffness"})  # fmt: skip
GIVEN = frozenset({"zero", "end"})
#: Parameters whose change moves nothing or makes a jump: sought from outside, by direct search.
OUTER = frozenset({("actuator.stiction", "band")})
#: Width of a hysteresis, of what the position moves through, below which it is dry friction, which has no width: its
#: springs would swing the faster the narrower it is, and a simulation would follow them.
LEAST_WIDTH = 1.0 / 300.0
#: How far surroundings may be from the coldest that was met [K].
SURROUNDINGS_SD = 15.0


def jumping(compiled: Compiled, effects: Sequence[Effect]) -> tuple[ModelParameter, ...]:
    """Return the parameters whose change moves nothing or makes a jump."""
    found = (one.parameter for one in compiled.held)
    return tuple(p for p in found if _in_outer(p, effects))


def _in_outer(p: ModelParameter, effects: Sequence[Effect]) -> bool:
    number, key = _number_and_key(p.name, effects)
    return (effects[number].name, key) in OUTER


def changed(effects: Sequence[Effect], i: int, key: str, value: float) -> tuple[Effect, ...]:
    """Return effects with one number of one of them changed."""
    parameters = dict(effects[i].parameters)
    parameters[key] = replace(parameters[key], value=value)
    return (*effects[:i], replace(effects[i], parameters=parameters), *effects[i + 1 :])


def scaled(trial: Trial, factor: float) -> Effect:
    """Return a trial's effect with its amplitude times a factor; what may not change its sign keeps it."""
    parameters = dict(trial.effect.parameters)
    for key in trial.scaled:
        signed = key in SIGNED or trial.effect.name in SIGNED_RATES
        times = factor if signed else abs(factor)
        parameters[key] = replace(parameters[key], value=parameters[key].value * times)
    return replace(trial.effect, parameters=parameters)


def sought(p: ModelParameter, effects: Sequence[Effect], spreads: Mapping[str, float]) -> ModelParameter:
    """Return an effect's parameter with the scale that it is sought on."""
    number, key = _number_and_key(p.name, effects)
    name = effects[number].name
    if key in GIVEN or p.spread == 0.0 or (name, key) in OUTER:
        return replace(p, spread=0.0)
    if (name, key) == ("plant.sine_torque", "period") and "phase" not in effects[number].parameters:
        return replace(p, spread=0.0)  # gravity on an angle
    if (name, key) == ("plant.hysteresis", "width"):
        return replace(p, least=spreads.get(f"width at {place_of(effects[number])}", 0.0))
    if (name, key) == ("plant.hard_stop", "stiffness"):
        # softer than what it turns round moves by itself it would be no stop, and its damping a loss of free place
        return replace(p, least=spreads.get(f"stiffness at {place_of(effects[number])}", 0.0))
    if key == "surroundings":
        return replace(p, linear=True, spread=SURROUNDINGS_SD)
    if key == "reference":
        return replace(p, linear=True, spread=spreads.get(f"reference of {effects[number].column}", 0.0))
    if key == "origin":
        size = spreads.get("origin of y" if name.startswith("sensor.") else "origin of u", 0.0)
        return replace(p, linear=True, spread=size)
    if key in SIGNED or (key in ("rate", "coefficient") and name in SIGNED_RATES):
        return replace(p, linear=True, spread=spreads.get(key, 3.0 * abs(p.value) + 1e-300))
    return p


def _number_and_key(name: str, effects: Sequence[Effect]) -> tuple[int, str]:
    for number, effect in enumerate(effects):
        prefix = f"{effect.name.split('.')[1]}_{number}_"
        if name.startswith(prefix):
            return number, name.removeprefix(prefix)
    raise AssertionError(name)
