"""A hysteresis that a search narrows until it is dry friction: the work of the fit stays bounded."""

from __future__ import annotations

import numpy as np

from autotune.diagnosis.equations.equation_bench import EquationBench
from autotune.effects.plant import LEAST_WIDTH
from autotune.equations import Drive, compile_model, simulate
from autotune.models import Effect, Parameter
from autotune.recording import Recording
from tests.autotune.equations.models import one_state

STATES = [
    {"name": "x", "kind": "position", "derivative": "v"},
    {"name": "v", "kind": "speed", "of": "x", "derivative": "u - 40*x - c*v"},
]


def test_a_fit_to_dry_friction_leaves_hysteresis_as_wide_as_a_simulation_can_follow() -> None:
    nominal = one_state("v", {"c": {"value": 0.5, "spread": 0.5}}, state=STATES)
    rubbed = [STATES[0], STATES[1] | {"derivative": "u - 40*x - c*v - 0.2*sign(v)"}]
    truth = compile_model(one_state("v", {"c": 0.5}, state=rubbed))
    rng = np.random.default_rng(3)
    t, u = 0.05 * np.arange(600), np.repeat(rng.normal(0.0, 2.0, 40), 15)
    y = simulate(truth, truth.parameter_vector, Drive(t=t, inputs=u[:, None]), np.zeros((1, 2))).y
    recording = Recording(t=t, u=u, y=y + rng.normal(0.0, 1e-4, t.size))
    bench = EquationBench(nominal, [recording], [np.ones(t.size, dtype=bool)])
    retuned = bench.retuned()
    span = float(np.ptp(bench.signals(retuned).values["x"]))
    values = {"amplitude": Parameter(value=0.2), "width": Parameter(value=0.05 * span)}
    found = bench.fitted([Effect(name="plant.hysteresis", state="v", parameters=values)], retuned, 8)
    assert found.rss < 0.5 * retuned.rss
    assert found.effects[0].parameters["width"].value >= LEAST_WIDTH * span
    (windows,) = found.fitted.windows
    run = simulate(found.fitted.compiled, found.fitted.parameters, Drive(t=t, inputs=u[:, None]), windows.states,
                   starts=windows.starts, stops=windows.stops)  # fmt: skip
    assert run.is_complete
    assert run.steps.sum() < 10 * t.size
