"""What a diagnosis does not do: it saves work where nothing can come of it, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.diagnosis.fitting.bases import basis, determined
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.noise import Noise
from autotune.diagnosis.selection.bench import at_once
from autotune.diagnosis.selection.chain_proposals import search_chain
from autotune.diagnosis.simulation.assembly import assemble
from autotune.diagnosis.thresholds import IN_USE
from autotune.effects import ALL
from autotune.models import Block, Model, Port, TransferFunction
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


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(3, 30), min_size=1, max_size=6), st.integers(1, 3))
def test_as_many_start_states_are_told_as_span_what_they_explain(seed: int, lengths: list[int], states: int) -> None:
    random = np.random.default_rng(seed)
    edges = np.cumsum([0, *lengths])
    windows, Jx = np.column_stack([edges[:-1], edges[1:]]), random.normal(size=(int(edges[-1]), states))
    for number, (a, b) in enumerate(windows):
        Jx[a:b, states - number % states :] = 0.0  # not felt
        if number % 2:
            Jx[a:b] = Jx[a:b, :1]  # all alike
    assert determined(Jx, windows) == sum(basis(Jx[a:b]).shape[1] for a, b in windows)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.5]))
def test_states_at_rest_are_found_for_all_windows_as_for_each(seed: int, stiffness: float) -> None:
    random = np.random.default_rng(seed)
    dynamics = TransferFunction(num=(2.0, 3.0), den=(0.4, 1.0, stiffness))
    sim = assemble(
        Model(name="m", input=Port(), output=Port(), blocks=(Block(name="b", place="plant", dynamics=dynamics),))
    )
    u, y = random.normal(size=(2, 7))
    together = sim.rest_states(u, y)
    assert together.shape == (7, 2)
    for one, command, reading in zip(together, u, y, strict=True):
        assert one == pytest.approx(sim.rest_state(command, reading), rel=1e-9, abs=1e-12)


def test_tasks_side_by_side_keep_their_order() -> None:
    assert at_once(lambda k: k * k, range(20)) == [k * k for k in range(20)]


@pytest.mark.parametrize(("sensor_lag_s", "pairs"), [(1e-9, False), (0.2, True)])
def test_a_rig_is_given_a_second_effect_only_where_more_than_noise_is_left(sensor_lag_s: float, pairs: bool) -> None:
    recording = recorded(drag=1.0, sensor_lag_s=sensor_lag_s)
    names = [k.name for k in ALL if k.name not in ("plant.quadratic_drag", "sensor.lag")]
    found = search_chain(lag(), [recording], [np.ones(ROWS, dtype=bool)], left_out=names)
    assert "plant.quadratic_drag" in found.chosen.names
    assert (set(found.chosen.names) == {"plant.quadratic_drag", "sensor.lag"}) is pairs
