"""On what scale the numbers of effects are sought, which of them from outside the fits, and which not at all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from autotune.diagnosis.equations.candidates import Trial, form_of, is_signed
from autotune.effects.in_equations import Scales
from autotune.equations.effects import prefix_of
from autotune.equations.model import ModelParameter
from autotune.equations.simulate import Compiled
from autotune.models import Effect

#: Prior standard deviation of a number of either sign whose record does not say, as a share of its value.
SIGNED_SPREAD = 3.0


def outer(effects: Sequence[Effect]) -> list[tuple[int, str]]:
    """Return which numbers of which effects move nothing or make a jump: sought from outside, by direct search."""
    return [(i, key) for i, e in enumerate(effects) for key in e.parameters if key in form_of(e).jumps]


def jumping(compiled: Compiled, effects: Sequence[Effect]) -> tuple[ModelParameter, ...]:
    """Return the parameters of a compiled model whose change moves nothing or makes a jump."""
    names = {prefix_of(effects[i], i) + key for i, key in outer(effects)}
    return tuple(one.parameter for one in compiled.held if one.parameter.name in names)


def change_number(effects: Sequence[Effect], i: int, key: str, value: float) -> tuple[Effect, ...]:
    """Return effects with one number of one of them changed."""
    return (*effects[:i], effects[i].with_values({key: value}), *effects[i + 1 :])


def scale_trial(trial: Trial, factor: float) -> Effect:
    """Return a trial's effect with its amplitude times a factor; what may not change its sign keeps it."""
    effect = trial.effect
    times = {key: factor if is_signed(effect, key) else abs(factor) for key in trial.scaled}
    return effect.with_values({key: effect.values[key] * by for key, by in times.items()})


def scale_parameter(p: ModelParameter, effects: Sequence[Effect], scales: Callable[[Effect], Scales]) -> ModelParameter:
    """Return an effect's parameter with the scale that it is sought on."""
    effect, key = _effect_and_key(p.name, effects)
    form = form_of(effect)
    held = form.held(effect.parameters) if form.held is not None else ()
    if p.spread == 0.0 or key in (*form.given, *form.jumps, *held):
        return replace(p, spread=0.0)
    if is_signed(effect, key):
        spread = form.spread[key](scales(effect)) if key in form.spread else 0.0
        return replace(p, linear=True, spread=spread or SIGNED_SPREAD * abs(p.value) + 1e-300)
    if key in form.least:
        return replace(p, least=form.least[key](scales(effect)))
    return p


def _effect_and_key(name: str, effects: Sequence[Effect]) -> tuple[Effect, str]:
    for number, effect in enumerate(effects):
        prefix = prefix_of(effect, number)
        if name.startswith(prefix):
            return effect, name.removeprefix(prefix)
    raise AssertionError(name)
