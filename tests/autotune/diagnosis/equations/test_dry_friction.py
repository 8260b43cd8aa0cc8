"""Dry friction's level has many minima: a plant at rest begins to move or not."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
import pytest

from autotune.diagnosis.equations.dry_friction import select_minimum, sweep_levels, with_force
from autotune.diagnosis.equations.equation_bench import EquationBench
from autotune.equations import Drive, simulate
from autotune.equations.effects import compile_with
from autotune.models import Effect, Parameter
from autotune.recording import Recording
from tests.autotune.equations.models import model

LEVEL = 3.0


def coulomb(level: float) -> Effect:
    return Effect(
        name="plant.coulomb_friction", state="omega", parameters=MappingProxyType({"level": Parameter(value=level)})
    )


def held(seed: int) -> Recording:
    """Return a pendulum that dry friction stops between the steps of its torque."""
    rng = np.random.default_rng(seed)
    u, t = np.repeat(rng.normal(0.0, 0.6, 20), 75), 0.02 * np.arange(1500)
    compiled = compile_with(model(), [coulomb(LEVEL)])
    y = simulate(compiled, compiled.parameter_vector, Drive(t=t, inputs=u[:, None]), np.zeros((1, 2))).y
    return Recording(t=t, u=u, y=y + 0.003 * rng.normal(size=t.size), name=f"held{seed}.csv")


def test_other_levels_lead_out_of_a_wrong_minimum_and_tell_how_far_a_level_may_be_off() -> None:
    recordings = [held(1), held(2)]
    bench = EquationBench(model(), recordings, [np.isfinite(r.y) for r in recordings])
    retuned = bench.retuned()
    bench.signals(retuned)
    stuck = bench.fitted([coulomb(8.0 * LEVEL)], retuned, 8)
    assert stuck.effects[0].parameters["level"].value > 2.0 * LEVEL
    fits = sweep_levels(bench, stuck)
    assert min(one.rss for one in fits) < 0.01 * stuck.rss
    told = select_minimum(bench, fits, 1000.0, 1.0).effects[0].parameters["level"]
    assert told.value == pytest.approx(LEVEL, rel=0.02)
    assert told.sd < 0.01 * LEVEL
    # where the model's own error is so large that rows tell none of these minima from another
    vague = select_minimum(bench, fits, 1000.0, 1e6).effects[0].parameters["level"]
    assert vague.sd >= abs(stuck.effects[0].parameters["level"].value - vague.value)


def test_only_dry_friction_has_its_force_changed() -> None:
    parameters = {key: Parameter(value=1.0) for key in ("level", "breakaway", "stribeck_speed")}
    stribeck = Effect(name="plant.stribeck_friction", state="omega", parameters=MappingProxyType(parameters))
    changed = with_force(stribeck, 0.5).parameters
    assert {key: q.value for key, q in changed.items()} == {"level": 0.5, "breakaway": 0.5, "stribeck_speed": 1.0}
    gain = Effect(name="sensor.nonlinear_gain", parameters=MappingProxyType({"second_order": Parameter(value=1.0)}))
    assert with_force(gain, 0.5) is gain
