"""Laws of extended models beyond what was recorded: they go on for one span at most, and nothing runs away."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.arrays import FloatArray
from autotune.diagnosis import diagnose
from autotune.diagnosis.simulation.assembly import assemble
from autotune.diagnosis.simulation.forecast import forecast
from autotune.effects import ALL
from autotune.models import Block, Effect, Model, Parameter, Port, TransferFunction
from autotune.recording import Recording

ENDED = [kind.name for kind in ALL if kind.goes_on is not None]
T = 0.02 * np.arange(3000)
#: Numbers that two sizes leave open: gravity of an arm, one turn of which is 6 units of travel; the gain beyond a bend.
OTHERS = {"period": 6.0, "gravity": 1.0, "slope": 1.0}


def plant(name: str, sizes: tuple[float, ...]) -> Model:
    """Return a servo whose spring pulls back, with an effect that ends at -1 and 1."""
    kind = next(k for k in ALL if k.name == name)
    given, sized = {**OTHERS, "low": -1.0, "high": 1.0}, iter(sizes)
    values = {q.name: given[q.name] if q.name in given else next(sized) for q in kind.parameters}
    effect = Effect(name=name, parameters=MappingProxyType({key: Parameter(value=v) for key, v in values.items()}))
    spring = TransferFunction(num=(4.0,), den=(1.0, 1.2, 4.0))
    speed = Block(name="servo", place="plant", dynamics=spring)
    return Model(name="servo", input=Port(), output=Port(), blocks=(speed,), effects=(effect,))


@pytest.mark.parametrize("name", ENDED)
@given(first=st.floats(-0.8, 0.8), second=st.floats(-0.8, 0.8))
def test_a_law_is_bounded_wherever_the_linear_model_is(name: str, first: float, second: float) -> None:
    simulator = assemble(plant(name, (first, second)))
    u = 20.0 * np.sign(np.sin(0.9 * T))
    drive, rest = Recording(t=T, u=u, y=0.0 * T, name="r"), np.zeros(simulator.order)
    y, linear = (one.run(drive, rest)[0][:, 0] for one in (simulator, simulator.linear()))
    assert float(np.abs(y).max()) < 4.0 * float(np.abs(linear).max())


def bent_lag(u: FloatArray, keeps: float) -> FloatArray:
    """Return y of tau dy/dt = -y + u - .15 u^2, solved exactly between samples."""
    y = np.zeros(u.size)
    for k in range(u.size - 1):
        y[k + 1] = keeps * y[k] + (1.0 - keeps) * (u[k] - 0.15 * u[k] ** 2)
    return y


def process(gain: float) -> Model:
    """Return a lag of .4 s."""
    lag = Block(name="lag", place="plant", dynamics=TransferFunction(num=(gain,), den=(0.4, 1.0)))
    return Model(name="process", input=Port(), output=Port(), blocks=(lag,))


def test_the_ends_are_one_span_beyond_what_was_recorded_and_not_beyond_where_the_law_turns() -> None:
    """A bend whose curve turns at u = 3.3, with u in -2..2."""
    rng = np.random.default_rng(5)
    u = np.repeat(rng.uniform(-2.0, 2.0, 60), 25)
    y = bent_lag(u, np.exp(-0.05 / 0.4))
    recording = Recording(t=0.05 * np.arange(u.size), u=u, y=y + 0.01 * rng.normal(size=u.size), name="r")
    found = diagnose(process(1.0), [recording])
    assert [e.name for e in found.effects] == ["actuator.nonlinear_gain"]
    assert not {"low", "high", "slope"} & set(found.effects[0].parameters)
    law = found.extended_model.effects[0].parameters
    centre, span = found.extended_model.input.offset, float(np.ptp(u))
    assert law["low"].value == pytest.approx(u.min() - span - centre, abs=0.05 * span)
    assert law["high"].value == pytest.approx(1.0 / 0.3, rel=0.1)


def test_a_bend_of_one_sign_of_the_command_goes_on_with_the_nominal_gain_on_the_other() -> None:
    """The same with u in 0..3, beside a nominal gain of .8: what it does below 0 the recording does not say."""
    rng = np.random.default_rng(5)
    u = np.repeat(rng.uniform(0.0, 3.0, 60), 25)
    u[:25] = 0.0
    y = bent_lag(u, np.exp(-0.05 / 0.4))
    recording = Recording(t=0.05 * np.arange(u.size), u=u, y=y + 0.01 * rng.normal(size=u.size), name="r")
    model = diagnose(process(0.8), [recording]).extended_model
    assert [e.name for e in model.effects] == ["actuator.nonlinear_gain"]
    steps = Recording(t=0.05 * np.arange(400), u=np.repeat([0.0, -2.0], 200), y=np.zeros(400), name="steps")
    simulated = forecast(model, steps)
    assert simulated[-1] - simulated[199] == pytest.approx(-1.6, abs=0.02)
