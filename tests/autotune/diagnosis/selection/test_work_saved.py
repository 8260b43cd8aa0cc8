"""What a diagnosis does not do: it saves work where nothing can come of it, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import fit
from autotune.diagnosis.fitting.noise import Noise
from autotune.diagnosis.fitting.parameters import parametrise
from autotune.diagnosis.selection.bench import at_once, fit_without, names_more_than_it_is
from autotune.diagnosis.selection.chain_proposals import search_chain
from autotune.diagnosis.selection.hypothesis import hypothesis
from autotune.diagnosis.simulation.assembly import assemble
from autotune.diagnosis.thresholds import IN_USE
from autotune.effects import ALL, KINDS
from autotune.models import Block, Effect, Model, Parameter, Port, TransferFunction
from autotune.recording import Recording

ROWS, WINDOW = 3000, 50


def lag(gain: float = 1.0, lag_s: float = 1.0) -> Model:
    block = Block(name="plant", place="plant", dynamics=TransferFunction(num=(gain,), den=(lag_s, 1.0)), output="speed")
    return Model(name="lag", input=Port(unit="V"), output=Port(unit="m/s"), blocks=(block,))


def recorded(drag: float = 0.0, added: float = 0.0, sensor_lag_s: float = 1e-9) -> Recording:
    """A lag with a loss that grows with the square of the speed, a slow disturbance, and a lag of the sensor."""
    rng = np.random.default_rng(3)
    dt, v, read = 0.05, 0.0, 0.0
    u, y = np.repeat(rng.uniform(-1.0, 1.0, ROWS // 30), 30), np.empty(ROWS)
    for k in range(ROWS):
        y[k] = read + added * np.sin(0.05 * k)
        for _ in range(10):
            v += dt / 10 * (u[k] - v - drag * v * abs(v))
            read = v + (read - v) * np.exp(-dt / 10 / sensor_lag_s)
    return Recording(t=dt * np.arange(ROWS), u=u, y=y + 0.01 * rng.standard_normal(ROWS))


def cut(recording: Recording) -> Data:
    starts = np.arange(0, ROWS, WINDOW)
    good = np.ones(ROWS, dtype=bool)
    return Data(
        recordings=(recording,), good=(good,), starts=(starts,), stops=(starts + WINDOW,), noise=Noise(sd=0.01),
        thresholds=IN_USE,
    )  # fmt: skip


@pytest.mark.parametrize("lag_s", [1e-1, 1e-4, 1e-9])
def test_a_sensor_s_start_states_are_paid_for_however_little_they_are_felt(lag_s: float) -> None:
    """Else a lag of a nanosecond, which does nothing, would come cheaper than one that does."""
    data = cut(recorded())
    sensor = Effect(name="sensor.lag", parameters={"time_constant": Parameter(value=lag_s)})
    alone, beside = (
        hypothesis(fit(parametrise(lag(), added, 1.0, 0.05, IN_USE.prior_spread), data, iterations=0))
        for added in ([], [sensor])
    )
    paid = beside.penalised_chi2 - beside.fit.cost - (alone.penalised_chi2 - alone.fit.cost)
    # a number, and a state in every window, but for what its prior of ten sizes holds back of it
    assert paid == pytest.approx(np.log(ROWS) + ROWS / WINDOW, abs=1e-3)


@pytest.mark.parametrize(("lag_s", "does_nothing"), [(0.3, False), (1e-2, False), (1e-5, True), (1e-9, True)])
def test_a_lag_that_frees_first_readings_alone_is_none(lag_s: float, does_nothing: bool) -> None:
    """Its state is the reading where a window begins: that is a start state's doing, in a record with noise."""
    data = cut(recorded(sensor_lag_s=lag_s))
    sensor = Effect(name="sensor.lag", parameters={"time_constant": Parameter(value=lag_s)})
    held = fit(parametrise(lag(), [sensor], 1.0, 0.05, IN_USE.prior_spread), data, free=np.zeros(4, dtype=bool))
    alone = fit(parametrise(lag(), [], 1.0, 0.05, IN_USE.prior_spread), data, free=np.zeros(3, dtype=bool))
    assert held.chi2 < alone.chi2 - 0.5 * ROWS / WINDOW  # what the first readings of windows have of noise is gone
    assert names_more_than_it_is(held, data) == does_nothing


@pytest.mark.parametrize("name", [kind.name for kind in ALL if kind.linear is not None and kind.linear.start])
@pytest.mark.parametrize("drive", [None, 0.3])
def test_an_effect_leaves_with_its_states(name: str, drive: float | None) -> None:
    """A rate limit brings a lag where the chain has none before the plant."""
    amplifier = Block(name="drive", place="actuator", dynamics=TransferFunction(num=(1.0,), den=(drive or 1.0, 1.0)))
    chain = Model(
        name="chain", input=Port(), output=Port(),
        blocks=(*((amplifier,) if drive else ()), Block(
            name="p", place="plant", dynamics=TransferFunction(num=(2.0,), den=(0.4, 1.0, 0.0)), output="position")),
    )  # fmt: skip
    kind, data = KINDS[name], cut(recorded())
    values = {q.name: Parameter(value=0.5) for q in kind.parameters}
    p = parametrise(chain, [Effect(name=name, parameters=values)], 1.0, 0.05, IN_USE.prior_spread)
    with_it = fit(p, data, free=np.zeros(p.centre.size, dtype=bool), iterations=0)
    assert isinstance(names_more_than_it_is(with_it, data), bool)
    assert fit_without(with_it, 0, data) is not None


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.5]))
def test_states_at_rest_are_found_for_all_windows_as_for_each(seed: int, stiffness: float) -> None:
    random = np.random.default_rng(seed)
    dynamics = TransferFunction(num=(2.0, 3.0), den=(0.4, 1.0, stiffness))
    sim = assemble(
        Model(name="m", input=Port(), output=Port(), blocks=(Block(name="b", place="plant", dynamics=dynamics),))
    )
    u, y = random.normal(size=(2, 7))
    together = sim.rest_states(u, y, 0.1)
    assert together.shape == (7, 2)
    for one, command, reading in zip(together, u, y, strict=True):
        assert one == pytest.approx(sim.rest_state(command, reading, 0.1), rel=1e-9, abs=1e-12)


def test_tasks_side_by_side_keep_their_order() -> None:
    assert at_once(lambda k: k * k, range(20)) == [k * k for k in range(20)]


@pytest.mark.parametrize(("sensor_lag_s", "pairs"), [(1e-9, False), (0.2, True)])
def test_a_rig_is_given_a_second_effect_only_where_more_than_noise_is_left(sensor_lag_s: float, pairs: bool) -> None:
    recording = recorded(drag=1.0, sensor_lag_s=sensor_lag_s)
    names = [k.name for k in ALL if k.name not in ("plant.quadratic_drag", "sensor.lag")]
    found = search_chain(lag(), [recording], [np.ones(ROWS, dtype=bool)], left_out=names)
    assert "plant.quadratic_drag" in found.chosen.names
    assert (set(found.chosen.names) == {"plant.quadratic_drag", "sensor.lag"}) is pairs
