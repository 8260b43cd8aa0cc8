"""What is found, in words."""

from __future__ import annotations

import pytest

from autotune.diagnosis.findings import alike
from autotune.diagnosis.result import FoundEffect

SAID = {"actuator.lag": 0.34, "sensor.lag": 0.34, "timing.dead_time": 0.21}


@pytest.mark.parametrize(
    ("name", "other"), [("actuator.lag", "timing.dead_time"), ("timing.dead_time", "actuator.lag")]
)
def test_a_lag_and_a_dead_time_are_said_together_and_lags_of_command_and_reading_count_once(
    name: str, other: str
) -> None:
    one = FoundEffect(
        name=name,
        probability=SAID[name],
        places=(),
        parameters={},
        equation="",
        windows=(),
        alike=alike(name, SAID, 0.1),
        together=0.55,
    )
    assert one.in_odds == f"probability {SAID[name]:.2f}; 0.55 with {other}, which does nearly the same"


def test_what_is_ruled_out_is_not_said_beside_an_effect() -> None:
    assert alike("sensor.lag", SAID | {"timing.dead_time": 0.09}, 0.1) == ()
    assert alike("plant.coulomb_friction", SAID, 0.1) == ()
