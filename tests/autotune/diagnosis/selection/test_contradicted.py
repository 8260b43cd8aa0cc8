"""A limit of the sensor cuts the noise in front of it off: readings that scatter on at it speak against it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from autotune.diagnosis.fitting.fit import fit
from autotune.diagnosis.fitting.parameters import effect_with
from autotune.diagnosis.fitting.retuning import prepare
from autotune.diagnosis.selection.hypothesis import contradicted_effects, hypothesis
from autotune.diagnosis.selection.prediction import extend
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

MODEL = Model(
    name="heater",
    input=Port(unit="V"),
    output=Port(unit="K"),
    blocks=(Block(name="heater", place="plant", dynamics=TransferFunction(num=(2.0,), den=(1.5, 1.0))),),
)
LIMIT, NOISE = 0.8, 0.02


def limited(in_front: float, behind: float) -> Recording:
    """Return y of 2/(1.5 s + 1) that ends at the limit, with noise in front of it and behind."""
    rng = np.random.default_rng(3)
    dt, rows = 0.05, 2000
    u = np.repeat(rng.uniform(-1.0, 1.0, rows // 40), 40)
    num, den, _ = signal.cont2discrete(([2.0], [1.5, 1.0]), dt)
    clean = signal.lfilter(num[0], den, u) + in_front * rng.normal(size=rows)
    return Recording(t=dt * np.arange(rows), u=u, y=np.minimum(clean, LIMIT) + behind * rng.normal(size=rows))


@pytest.mark.parametrize(
    ("recording", "names"),
    [
        (limited(NOISE, 0.0), frozenset()),
        (limited(NOISE, 0.3 * NOISE), frozenset()),
        (limited(0.0, NOISE), frozenset(["sensor.saturation"])),
    ],
)
def test_readings_that_scatter_on_at_a_limit_speak_against_a_limit_of_the_sensor(
    recording: Recording, names: frozenset[str]
) -> None:
    data, base = prepare(MODEL, [recording], [np.ones(len(recording), dtype=bool)])
    effect = effect_with("sensor.saturation", (-2.0, LIMIT), ("K", "K"))
    parametrisation, theta, x0 = extend(base, effect, data)
    found = hypothesis(fit(parametrisation, data, theta, x0))
    assert found.names == ("sensor.saturation",)
    assert contradicted_effects(found, data) == names


def test_without_a_limit_nothing_is_contradicted() -> None:
    recording = limited(0.0, NOISE)
    data, base = prepare(MODEL, [recording], [np.ones(len(recording), dtype=bool)])
    assert contradicted_effects(hypothesis(base), data) == frozenset()
