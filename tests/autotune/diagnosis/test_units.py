"""Seconds, volts and bars are names: a diagnosis in other units is the same, to rounding."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy.linalg import expm

from autotune.config.procedure import LimitSettings
from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.result import Diagnosis
from autotune.diagnosis.simulation.assembly import assemble
from autotune.effects import KINDS
from autotune.equations import EquationModel
from autotune.experiment_design.conditions import Conditions
from autotune.experiment_design.plan import excitations
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording
from tests.autotune.equations.models import model

TRIED = ("actuator.lag", "sensor.lag", "plant.resonance", "environment.gain_step", "actuator.dead_zone")


def heated_model(second: float = 1.0, volt: float = 1.0, bar: float = 1.0) -> Model:
    """Return two lags behind a dead time in other units, other ones than are recorded."""
    return Model(
        name="heated",
        input=Port(),
        output=Port(),
        blocks=(
            Block(
                name="heater", place="actuator",
                dynamics=TransferFunction(num=(1.3 * bar / volt,), den=(0.8 * second, 1.0)),
            ),
            Block(
                name="wall", place="plant",
                dynamics=TransferFunction(num=(1.0,), den=(0.3 * second, 1.0), delay_s=0.2 * second),
            ),
        ),
    )  # fmt: skip


def heated_equations() -> EquationModel:
    """Return the same model in equations."""
    return model(
        input=[{"column": "u", "delay": 0.2}],
        output={"value": "b"},
        state=[{"name": "a", "derivative": "(gain*u - a)/heater"}, {"name": "b", "derivative": "(a - b)/wall"}],
        parameters={"gain": {"value": 1.3}, "heater": {"value": 0.8}, "wall": {"value": 0.3}},
    )


@lru_cache
def heated(second: float, volt: float, bar: float, dead: float = 0.0) -> Diagnosis:
    """Diagnose a recording in other units, with a dead zone of the actuator or none."""
    recording = heated_recording(second, volt, bar, dead)
    return diagnose(heated_model(second, volt, bar), [recording], without=[name for name in KINDS if name not in TRIED])


def heated_recording(second: float, volt: float, bar: float, dead: float, begins: bool = False) -> Recording:
    """Record it from a step on, or from rest."""
    rng = np.random.default_rng(3)
    rows, dt, first, last, late = 1500, 0.02, 0.0, 0.0, [0.0] * 10
    u = np.repeat(rng.choice([-1.0, 1.0], rows // 100) * rng.uniform(0.4, 1.0, rows // 100), 100)
    u[:100] *= begins
    y = np.empty(rows)
    held = expm(dt * np.array([[-1.25, 0.0, 1.875], [4.0, -4.0, 0.0], [0.0, 0.0, 0.0]]))
    for k in range(rows):
        y[k] = last + 0.01 * rng.standard_normal()
        now, *late = [*late, np.sign(u[k]) * max(abs(u[k]) - dead, 0.0)]
        first, last = held[:2] @ [first, last, now]
    return Recording(t=second * dt * np.arange(rows), u=volt * u, y=bar * y)


# powers of two leave every digit as it is; a minute, 1.8 and 1e5 do not
@pytest.mark.parametrize(("units", "rounding"), [((2.0**-10, 2.0**-40, 2.0**30), 1e-9), ((60.0, 1.8, 1e5), 1e-3)])
def test_a_diagnosis_is_the_same_in_other_units(units: tuple[float, float, float], rounding: float) -> None:
    usual, other = heated(1.0, 1.0, 1.0, dead=0.3), heated(*units, dead=0.3)
    assert [e.name for e in usual.effects] == ["actuator.dead_zone"]
    said = {c.name: c.probability for c in usual.candidates}
    assert {c.name: c.probability for c in other.candidates} == pytest.approx(said, abs=rounding)
    assert other.fit.extended == pytest.approx(usual.fit.extended, rel=1e-6)
    (width,) = usual.effects[0].parameters.values()
    (there,) = other.effects[0].parameters.values()
    assert there.value == pytest.approx(units[1] * width.value, rel=1e-4)
    assert width.value == pytest.approx(0.3, abs=3.0 * width.sd)


def test_experiments_are_planned_in_whatever_units() -> None:
    second, volt, bar = 2.0**-10, 2.0**-40, 2.0**30

    def planned(second: float, volt: float, bar: float) -> list[tuple[str, float, float]]:
        limits = LimitSettings(
            u_min=-volt,
            u_max=volt,
            u_safe=0.0,
            y_min=-2.0 * bar,
            y_max=2.0 * bar,
            swing=0.5 * bar,
            u_rate=volt / second,
        )
        there = Conditions(limits=limits, y=0.1 * bar, sample_time_s=0.02 * second)
        found = excitations(assemble(heated_model(second, volt, bar)), there, 20.0 * second)
        return [(one.kind, one.amplitude / volt, one.hold_s / second) for one in found]

    usual = planned(1.0, 1.0, 1.0)
    assert len(usual) >= 3
    for one, other in zip(planned(second, volt, bar), usual, strict=True):
        assert one[0] == other[0]
        assert one[1:] == pytest.approx(other[1:], rel=1e-3)  # written with four digits


def test_a_recording_that_begins_with_a_step_is_not_short_of_physics_for_it() -> None:
    """What was commanded before it began is not known, and comes out of the dead time in its first rows."""
    recording = heated_recording(1.0, 1.0, 1.0, 0.0, begins=True)
    for nominal in (heated_model(), heated_equations()):
        found = diagnose(nominal, [recording])
        assert found.verdict == "parameters"
        assert not found.effects
