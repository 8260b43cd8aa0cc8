"""Score tests: chance stays below the bound; what swings or goes past the chain is found, with its period."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.constancy import Variation, largest_variation
from autotune.diagnosis.fitting.retuning import prepare
from autotune.diagnosis.thresholds import IN_USE
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

SAMPLE_S, LAG_S, ROWS = 0.1, 1.0, 3000
MODEL = Model(
    name="lag",
    blocks=(Block(name="plant", place="plant", dynamics=TransferFunction(num=(1.0,), den=(LAG_S, 1.0))),),
    input=Port(unit="V"),
    output=Port(unit="V"),
)


def recorded(
    seed: int,
    gain: FloatArray | float = 1.0,
    lag_s: FloatArray | float = LAG_S,
    crosstalk: float = 0.0,
    echo: float = 0.0,
    feedback: float = 0.3,
) -> Variation:
    """What varies in a lag under a P controller with a random set-point, driven exactly from row to row."""
    rng = np.random.default_rng(seed)
    aim = np.repeat(rng.choice([-1.0, 1.0], ROWS // 20), 20)
    gains, decay = gain * np.ones(ROWS), np.exp(-SAMPLE_S / (lag_s * np.ones(ROWS)))
    t, x, held = SAMPLE_S * np.arange(ROWS), 0.0, 0.0
    u, y, level = np.empty(ROWS), np.empty(ROWS), np.zeros(ROWS)
    for k in range(ROWS):
        level[k] = x
        past = level[k - 15] if k >= 15 else 0.0
        y[k] = x + crosstalk * held + echo * past + 0.03 * rng.standard_normal()
        u[k] = held = aim[k] - feedback * y[k]
        x = decay[k] * x + (1.0 - decay[k]) * gains[k] * u[k]
    data, retuned = prepare(MODEL, [Recording(t=t, u=u, y=y)], [np.ones(ROWS, dtype=bool)])
    return largest_variation(retuned, data)


def swing(period_s: float, depth: float) -> FloatArray:
    return np.asarray(1.0 + depth * np.sin(2.0 * np.pi * SAMPLE_S * np.arange(ROWS) / period_s))


def test_a_model_that_is_right_leaves_chance_in_open_and_closed_loop() -> None:
    # the largest of some hundred chi-squares of two degrees: its median lies near 2 ln(100/0.7)
    gains = [recorded(seed, feedback=feedback).gain for seed in range(5) for feedback in (0.0, 3.0)]
    assert max(gains) < IN_USE.beyond_chance
    assert 6.0 < float(np.median(gains)) < 14.0


def test_a_slow_swing_of_the_gain_may_be_the_commands_or_the_readings() -> None:
    slow, quick = (set(recorded(1, gain=swing(period_s, 0.1)).places) for period_s in (150.0, 8.0))
    assert {"actuator", "plant", "sensor"} <= slow
    assert quick == {"actuator", "plant"}


def test_a_gain_that_swings_is_found_with_its_period() -> None:
    found = recorded(1, gain=swing(20.0, 0.1))
    assert found.gain > IN_USE.beyond_chance
    assert found.what.startswith("the command")
    assert found.period_s == pytest.approx(20.0, rel=0.08)


def test_a_lag_that_swings_is_found_with_its_period() -> None:
    found = recorded(2, lag_s=LAG_S * swing(30.0, 0.2))
    assert found.gain > IN_USE.beyond_chance
    assert found.period_s == pytest.approx(30.0, rel=0.12)


def test_a_gain_that_is_switched_is_found() -> None:
    assert recorded(3, gain=np.where(np.sin(swing(50.0, 1.0) - 1.0) > 0.0, 1.1, 0.95)).gain > IN_USE.beyond_chance


def test_a_command_that_the_reading_hears_is_told_from_feedback() -> None:
    found = recorded(4, crosstalk=0.05, feedback=3.0)
    assert found.gain > IN_USE.beyond_chance
    assert "cross-talk" in found.what
    assert found.places == ("sensor",)


def test_an_echo_of_the_reading_is_found() -> None:
    found = recorded(5, echo=0.1)
    assert found.gain > IN_USE.beyond_chance
    assert found.places == ("sensor",)
