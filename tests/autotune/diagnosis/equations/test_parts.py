"""Long recordings: effects are sought on the part that says most, and fitted to all rows."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest

from autotune.arrays import FloatArray
from autotune.diagnosis import diagnose
from autotune.diagnosis.equations.bench import Outcome
from autotune.diagnosis.equations.equation_bench import EquationBench
from autotune.diagnosis.equations.equation_proposals import _lengthen
from autotune.diagnosis.equations.parts import telling_windows
from autotune.equations import Drive, compile_model, simulate
from autotune.equations.effects import compile_with
from autotune.errors import InputError
from autotune.models import Effect, Parameter
from autotune.recording import Recording
from tests.autotune.equations.models import PENDULUM, model, one_state

LAG = one_state("b*u - a*x", {"a": 0.8, "b": 2.0})


def recorded(seed: int, rows: int, high: float, limited: slice) -> Recording:
    """Return a lag's recording whose command is limited in some rows alone."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, rows // 25), 25)
    arriving = u.copy()
    arriving[limited] = np.minimum(u[limited], high)
    drive = Drive(t=0.05 * np.arange(rows), inputs=arriving[:, None])
    compiled = compile_model(LAG)
    y = simulate(compiled, np.array([0.85, 1.9]), drive, np.zeros((1, 1))).y
    return Recording(t=drive.t, u=u, y=y + 0.01 * rng.normal(size=rows), name=f"rec{seed}.csv")


def test_the_part_is_where_a_fit_leaves_most_and_has_windows_in_a_row() -> None:
    recordings = [recorded(k, 3000, 0.2, slice(1500, 2500)) for k in range(2)]
    bench = EquationBench(LAG, recordings, [np.isfinite(r.y) for r in recordings])
    retuned = bench.retuned()
    for w, kept in zip(retuned.fitted.windows, telling_windows(retuned.fitted, 2000), strict=True):
        assert np.array_equal(np.diff(np.flatnonzero(kept)), np.ones(kept.sum() - 1))
        assert w.starts[kept][0] >= 1000
        assert w.stops[kept][-1] <= 3000
    part = bench.part(retuned, 2000)
    assert part is not None
    assert 1500 <= part[1].residual.size <= 2500
    assert bench.part(retuned, 6000) is None


def test_an_effect_is_sought_on_a_part_and_judged_on_all_rows() -> None:
    recordings = [recorded(k, 3000, 0.3, slice(0, 3000)) for k in range(2)]
    found = diagnose(LAG, recordings)
    assert [e.name for e in found.effects] == ["actuator.saturation"]
    assert found.effects[0].parameters["high"].value == pytest.approx(0.3, abs=0.01)
    assert all(one.rows == 6000 for one in found.search.found.judged)
    assert found.fit.extended == pytest.approx(found.fit.noise_floor, rel=0.1)


def test_where_the_best_fit_runs_away_on_long_windows_the_others_are_not_compared_with_it() -> None:
    class Fleeing(EquationBench):
        def lengthened(self, outcome: Outcome) -> Outcome:
            raise InputError("the simulation runs away", where=self.model.name)

    recording = recorded(1, 1000, 9.0, slice(0))
    bench = Fleeing(LAG, [recording], [np.isfinite(recording.y)])
    noise = bench.retuned()
    assert _lengthen(bench, [noise, replace(noise, residual=10.0 * noise.residual)]) == []


def swung(seed: int, size: float = 0.8, rows: int = 900) -> Recording:
    """Return a pendulum under a driving torque, by its own equations."""
    rng = np.random.default_rng(seed)
    u, t = np.repeat(rng.normal(0.0, size, rows // 25), 25), 0.02 * np.arange(rows)
    compiled = compile_model(model())
    y = simulate(compiled, compiled.parameter_vector, Drive(t=t, inputs=u[:, None]), np.zeros((1, 2))).y
    return Recording(t=t, u=u, y=y + 0.003 * rng.normal(size=rows), name=f"swing{seed}.csv")


def test_gravity_that_a_spring_stands_for_is_one_number() -> None:
    """m g l sin(theta) over one turn, from where the angle is zero; the spring comes to nothing."""
    states = [PENDULUM["state"][0], {**PENDULUM["state"][1], "derivative": "(u - c*omega - k*theta)/J"}]
    numbers = {"J": {"value": 0.05}, "c": {"value": 0.02}, "k": {"value": 1.3}}
    found = diagnose(model(state=states, parameters=numbers), [swung(1), swung(2)])
    (gravity,) = found.extended_model.effects
    assert (gravity.name, gravity.state) == ("plant.sine_torque", "omega")
    assert set(gravity.parameters) == {"amplitude", "period"}
    # in units of the derivative: m g l / J
    J = found.search.found.chosen.outcome.fitted.parameters[0]
    assert gravity.parameters["amplitude"].value * J == pytest.approx(0.5 * 9.81 * 0.3, rel=0.05)


@pytest.mark.parametrize(("stiffness", "gives_way"), [(2000.0, False), (20.0, True)])
def test_a_stop_that_gives_way_by_far_is_none(stiffness: float, gives_way: bool) -> None:
    values = {"high": 0.4, "stiffness": stiffness, "damping": 0.02 * stiffness}
    parameters = MappingProxyType({key: Parameter(value=value) for key, value in values.items()})
    stop = Effect(name="plant.hard_stop", state="omega", parameters=parameters)
    recordings = [stopped(stop, seed) for seed in (3, 4)]
    bench = EquationBench(model(), recordings, [np.isfinite(r.y) for r in recordings])
    one = bench.fitted([stop], bench.as_it_is(bench.retuned()), 8)
    assert bench.is_stand_in(one) == gives_way


def stopped(stop: Effect, seed: int) -> Recording:
    """Return a swing against a stop."""
    r, compiled = swung(seed, 0.3), compile_with(model(), [stop])
    start: FloatArray = np.zeros((1, 2))
    y = simulate(compiled, compiled.parameter_vector, Drive(t=r.t, inputs=r.u[:, None]), start).y
    return Recording(t=r.t, u=r.u, y=y, name=r.name)
