"""An effect whose amplitude is not as large as its own standard deviation is none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from autotune.diagnosis.fitting.fit import fit
from autotune.diagnosis.fitting.parameters import effect_with
from autotune.diagnosis.fitting.retuning import prepare
from autotune.diagnosis.selection.hypothesis import hypothesis, vanished
from autotune.diagnosis.selection.prediction import extended
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

MODEL = Model(
    name="heater",
    input=Port(unit="V"),
    output=Port(unit="K"),
    blocks=(Block(name="heater", place="plant", dynamics=TransferFunction(num=(2.0,), den=(1.5, 1.0))),),
)


def heated(lag_s: float, drop: float) -> Recording:
    """Return y of 2/(1.5 s + 1) behind a sensor's lag, negative for a lead, and a dead zone, negative for a jump."""
    rng = np.random.default_rng(8)
    dt, rows = 0.05, 2000
    u = np.repeat(rng.uniform(-1.0, 1.0, rows // 40), 40)
    w = np.sign(u) * np.maximum(np.abs(u) - drop, 0.0)
    lead = [2.0 * max(-lag_s, 0.0), 2.0] if lag_s < 0.0 else [2.0]
    num, den, _ = signal.cont2discrete((lead, np.polymul([1.5, 1.0], [lag_s, 1.0] if lag_s > 0.0 else [1.0])), dt)
    y = signal.lfilter(num[0], den, w) + 0.01 * rng.normal(size=rows)
    return Recording(t=dt * np.arange(rows), u=u, y=y)


@pytest.mark.parametrize(
    ("name", "start", "recording", "nothing"),
    [
        ("sensor.lag", 0.1, heated(-0.05, 0.0), True),
        ("sensor.lag", 0.1, heated(0.2, 0.0), False),
        ("actuator.dead_zone", 0.02, heated(0.0, -0.05), True),
        ("actuator.dead_zone", 0.02, heated(0.0, 0.1), False),
    ],
)
def test_an_effect_that_would_have_to_be_less_than_nothing_vanishes(
    name: str, start: float, recording: Recording, nothing: bool
) -> None:
    data, base = prepare(MODEL, [recording], [np.ones(len(recording), dtype=bool)])
    found = hypothesis(fit(*_with(base, data, name, start)))
    assert found.names == (name,)
    assert vanished(found) == (frozenset([name]) if nothing else frozenset())


def _with(base, data, name, start):  # type: ignore[no-untyped-def]
    parametrisation, theta, x0 = extended(base, effect_with(name, (start,), ("",)), data)
    return parametrisation, data, theta, x0
