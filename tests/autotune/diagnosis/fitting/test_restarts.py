"""Start states that a stop holds are found anew from the windows' beginnings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autotune.diagnosis.evidence.samples import inspect
from autotune.diagnosis.fitting.fit import fit
from autotune.diagnosis.fitting.parameters import effect_with, parametrise
from autotune.diagnosis.fitting.restarts import restarted
from autotune.diagnosis.fitting.retuning import prepare, reduced_chi2
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

DT, NOISE, STOP = 0.02, 0.01, 0.4


def carriage(rows: int = 1200, fine: int = 20) -> Recording:
    """Carriage with a speed lag of 0.2 s that runs against a stop every few seconds, and does not rebound."""
    rng = np.random.default_rng(3)
    t = DT * np.arange(rows, dtype=np.float64)
    u = np.where(np.sin(2.1 * t) > 0.0, 1.0, -1.0)
    y, v, x = np.empty(rows), 0.0, -0.3
    for k in range(rows):
        y[k] = x
        for _ in range(fine):
            v += DT / fine * (u[k] - v) / 0.2
            x += DT / fine * v
            if x > STOP:
                x, v = STOP, min(v, 0.0)
    return Recording(t=t, u=u, y=y + NOISE * rng.normal(size=rows))


@pytest.fixture
def chain() -> Model:
    speed = Block(name="speed", place="plant", dynamics=TransferFunction(num=(1.0,), den=(0.2, 1.0)))
    place = Block(name="position", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.0)))
    return Model(name="carriage", input=Port(unit="V"), output=Port(unit="m"), blocks=(speed, place))


def test_a_window_that_starts_beyond_a_stop_comes_free_by_its_beginning_alone(chain: Model) -> None:
    recording = carriage()
    data, base = prepare(chain, [recording], inspect([recording])[0])
    p = parametrise(chain, [effect_with("plant.hard_stop", (-10.0, STOP))], 1.0, DT)
    data = replace(data, noise=replace(data.noise, sd=NOISE, ar=()))
    states = base.x0[0].copy()
    states[0] = (30.0, 3.0 * STOP)  # there is no window before it whose end it could start from
    held = np.zeros(p.centre.size, dtype=bool)
    stuck = fit(p, data, x0=[states], free=held)
    free = restarted(stuck, data)
    assert reduced_chi2(stuck, data) > 5.0
    assert reduced_chi2(free, data) == pytest.approx(1.0, abs=0.1)
    assert free.model.effects[0].parameters["high"].value == pytest.approx(STOP, abs=NOISE)


def test_a_fit_of_which_no_window_stands_out_is_left_as_it_is(chain: Model) -> None:
    recording = carriage()
    data, _ = prepare(chain, [recording], inspect([recording])[0])
    p = parametrise(chain, [effect_with("plant.hard_stop", (-10.0, STOP))], 1.0, DT)
    found = fit(p, data)
    assert restarted(found, data) is found
