"""What is found, in words."""

from __future__ import annotations

import pytest

from autotune.diagnosis.findings import effect_in_words
from autotune.diagnosis.result import FoundEffect

LAG, DEAD_TIME = {"actuator.lag": 0.34, "sensor.lag": 0.34}, {"timing.dead_time": 0.21}


def effect(name: str, probability: float) -> FoundEffect:
    return FoundEffect(name=name, probability=probability, places=(), parameters={}, equation="", windows=())


@pytest.mark.parametrize(
    ("name", "other"), [("actuator.lag", "timing.dead_time"), ("timing.dead_time", "actuator.lag or sensor.lag")]
)
def test_a_lag_and_a_dead_time_are_said_together_and_lags_of_command_and_reading_count_once(
    name: str, other: str
) -> None:
    said = LAG | DEAD_TIME
    words = effect_in_words(effect(name, said[name]), said, 0.1)
    assert words == f"{name} (probability {said[name]:.2f}; 0.55 with {other}, which does nearly the same)"


def test_what_is_ruled_out_is_not_said_beside_an_effect() -> None:
    assert effect_in_words(effect("sensor.lag", 0.9), LAG | {"timing.dead_time": 0.09}, 0.1) == (
        "sensor.lag (probability 0.90)"
    )
